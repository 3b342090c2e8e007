"""Problems with known answers, for the tests and for the accuracy benchmark."""

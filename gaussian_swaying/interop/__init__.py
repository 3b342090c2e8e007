"""Files and conventions of other programs."""

"""Tables, values and plots made from the recorded JSON; each file has the name of the case that records its data."""

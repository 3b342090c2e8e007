"""Tables, values and plots made from the recorded JSON; each file is named after the case that records it."""

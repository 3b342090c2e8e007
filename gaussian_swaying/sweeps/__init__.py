"""Many runs of one configuration: axes, worker processes, one table, and a data set of the results."""

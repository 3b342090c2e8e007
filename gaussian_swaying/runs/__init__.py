"""The folder of a run: held by one process, its files sealed, ended in order by signals."""

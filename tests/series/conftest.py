"""The parts of the series are run by ``run.py``, in processes of their own."""

collect_ignore_glob = ["*_cases.py", "run.py", "commands.py", "sandbox.py", "small.py"]

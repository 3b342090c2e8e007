"""Behind ``python tools/bench.py``: cases that measure, tables of the records, and the pages that show them."""

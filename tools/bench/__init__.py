"""Behind ``python tools/bench.py``: cases that measure, tables of what was recorded, and the pages that show them."""

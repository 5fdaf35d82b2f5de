"""Benchmarks: run time against error, stability, the thesis's tables, what each feature costs.

`palpate bench NAME` runs one. A bench is a module with a `BENCH` (see `runner`): its cases are
data, one function runs a case and returns rows, figures and summary are drawn from the rows.
"""

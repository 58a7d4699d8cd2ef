"""The paper's tables and figures, measured again: ``python results.py``. What each shows and on which data:
docs/results.md.
"""

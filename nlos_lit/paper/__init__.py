"""The paper's tables and figures, measured again: ``python results.py``.

One module a table or figure; `experiments` lists them. What each shows and on which data: docs/results.md.
"""

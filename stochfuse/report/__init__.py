"""Results as tables, records and figures; nothing is computed here.

A file shows one kind of result; `table` has tables and where they go in every format, `plot` what figures share.
It knows all results, and nothing of the command line.  A new kind of result is one file with a table, records and a
figure.
"""

"""Results as tables, records and figures; nothing is computed here.

A file shows one kind of result.  What all have in common is written once: `table` has the forms (`Report`), tables,
and where they go in every format; `rows` says what the rows of a result stand for, and along what its curves run;
`plot` has what figures share.  `results` knows which file shows which kind of result, `document` makes a page to send.
The room knows all results, and nothing of the command line.  A new kind of result is one file with a table, records, a
JSON object and a figure, and an entry in `results`.
"""

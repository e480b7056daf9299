"""The tables of a scenario file: their structure for pydantic (`schema` and its parts), and how each is read.

Structure says which keys there are and what kind of value each takes; reading checks whether the numbers fit together
and makes arrays of them.
"""

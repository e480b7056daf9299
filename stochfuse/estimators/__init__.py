"""What the agents do with what arrives: one file an estimator, behind one protocol, no chance in it.

Doors: `protocol` (what an engine may ask of an estimator) and `making.make` (an estimator by its name, for a
system). Estimators whose estimates are sums of information write them into a `ledger`; the others write down pasts
(`recursion`). `world` holds what the filters are told and how noises truly hang together; `fusion_graph` explains
one history; `progress` hands on what long work says of how far it is.

It knows scenarios as a `System`, and the rooms below.  To add one: its file here, its entry in
`stochfuse.scenario.registry` (and what it does not take in `capabilities`), its row in the tests' matrix.
"""

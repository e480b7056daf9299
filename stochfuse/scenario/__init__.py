"""What is given: read from a file, checked once, frozen; and its one translation for all that computes.

Doors: `scenario.load_scenario` (a preset, a file, a mapping → `Scenario`) and `system.System` with `Items` (what
engines see).  `schema` says which keys there are, `tables`, `motion` and `sensing` (models and sensors by name),
`cooperative` and `navigation` read them, `checker` remembers what was wrong, `model` and `network` are what comes of
it.  `registry` declares what can be asked of a scenario, `capabilities` what takes what.

It knows the kernel and the rules of fusion.  A new key: its field in `schema`, its reading in `tables`, its place in
`Scenario` and, where engines need it, in `System`; a feature that not everybody takes: its entry in `capabilities`.  A
sensor by name: a row of `sensing.KINDS`, and a part with value and slope for what none measures yet.
"""

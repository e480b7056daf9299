"""What is given: read from a file, checked once, frozen; and its one translation for all that computes.

Called, this room makes a scenario of arrays and numbers, with a scenario file's tables as arguments:

    >>> import stochfuse as sf
    >>> s = sf.scenario(model={"F": 1, "H": 1, "Q": 25, "R": 100}, initial=100, network={"agents": 3, "steps": 5})
    >>> s
    Scenario(scenario: 3 agents, ad-hoc, 5 steps, state (x))

Doors: `scenario.load_scenario` (a preset, a file, a mapping → `Scenario`) and `system.System` with `Items` (what
engines see).  `schema` says which keys there are, `tables`, `motion` and `sensing` (models and sensors by name),
`cooperative` and `navigation` read them, `checker` remembers what was wrong, `model` and `network` are what comes of
it.  `registry` declares what can be asked of a scenario, `capabilities` what takes what.  `links` reads packet logs,
`known_links` those of scenarios too, `link_memory` tells their bursts, `radio` works links out, `adapters` take what
people have in Python; `result` is what whatever can be shown has in common.

It knows the kernel and the rules of fusion.  A new key: its field in `schema`, its reading in `tables`, its place in
`Scenario` and, where engines need it, in `System`; a feature that not everybody takes: its entry in `capabilities`.  A
sensor by name: a row of `sensing.KINDS`, and a part with value and slope for what none measures yet.
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stochfuse.scenario.adapters import scenario


class Room(ModuleType):
    """The package, which can be called as well: `sf.scenario(model=…)` and `import stochfuse.scenario.links`.

    Once any file of the package is imported, the import system sets `stochfuse.scenario` to the package, whatever stood
    there before.  A function of that name would come and go with the imports that happened, so that the package itself
    is the function.
    """

    if TYPE_CHECKING:
        __call__ = staticmethod(scenario)
    else:

        def __call__(self, *args, **kwargs):
            return import_module("stochfuse.scenario.adapters").scenario(*args, **kwargs)

    @property
    def __signature__(self) -> Any:
        """What `inspect.signature` and editors show: the function's."""
        from inspect import signature

        return signature(import_module("stochfuse.scenario.adapters").scenario)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled by its name, as functions are."""
        return import_module, (__name__,)


sys.modules[__name__].__class__ = Room

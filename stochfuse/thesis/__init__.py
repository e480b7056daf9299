"""What the thesis found, found here: every figure and table of its chapters 3 and 4, and the run time it measured.

Doors: `catalogue` and `find` (every item), `sheet` and `page` (its panels with the statements), `statements`; for
figures of one's own `Sweep`, what a scenario and network gives over link probabilities.

    bench         the numbers, each calculated once; a `Sweep` asks for them
    figures       quantities: what a figure shows of some sweeps
    catalogue     the figures and tables, declared: quantity, scenario, networks, fusion rules
    about_…       the thesis' statements, each declared above the check of our numbers

It knows the reports that show it.  A new figure is one entry in `catalogue`, a new statement one in the `about_` file
of its chapter.
"""

from stochfuse.thesis.bench import STEADY as STEADY
from stochfuse.thesis.bench import TABLE_3 as TABLE_3
from stochfuse.thesis.bench import TRANSIENT as TRANSIENT
from stochfuse.thesis.bench import Bench as Bench
from stochfuse.thesis.bench import Sweep as Sweep
from stochfuse.thesis.bench import ThesisCase as ThesisCase
from stochfuse.thesis.catalogue import catalogue as catalogue
from stochfuse.thesis.catalogue import find as find
from stochfuse.thesis.catalogue import listing as listing
from stochfuse.thesis.catalogue import page as page
from stochfuse.thesis.catalogue import sheet as sheet
from stochfuse.thesis.catalogue import statements as statements
from stochfuse.thesis.runtime import timing as timing

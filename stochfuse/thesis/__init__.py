"""What the thesis found, found here: every figure and table of its chapters 3 and 4, and the run time it measured.

Doors: `catalogue.catalogue` and `find` (every item), `sheet` and `page` (its panels with the statements).  `bench`
has the numbers, each calculated once, `figures` and `tables` the families of items, `about_…` the thesis'
statements and how our numbers judge them.  It knows the reports that show it.  A new statement is one entry in the
`about_` file of its chapter.
"""

from stochfuse.thesis.bench import Bench as Bench
from stochfuse.thesis.catalogue import catalogue as catalogue
from stochfuse.thesis.catalogue import find as find
from stochfuse.thesis.catalogue import listing as listing
from stochfuse.thesis.catalogue import page as page
from stochfuse.thesis.catalogue import sheet as sheet
from stochfuse.thesis.runtime import Timing as Timing
from stochfuse.thesis.runtime import timing as timing

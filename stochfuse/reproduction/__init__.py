"""What the thesis found, found here: every figure and table of its chapters 3 and 4, and the run time it measured."""

from stochfuse.reproduction.bench import Bench as Bench
from stochfuse.reproduction.catalogue import catalogue as catalogue
from stochfuse.reproduction.catalogue import find as find
from stochfuse.reproduction.pages import listing as listing
from stochfuse.reproduction.pages import page as page
from stochfuse.reproduction.pages import sheet as sheet
from stochfuse.reproduction.runtime import Timing as Timing
from stochfuse.reproduction.runtime import timing as timing

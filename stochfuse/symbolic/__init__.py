"""The formulas themselves: (54), (49) and the optimum over exact algebra, as polynomials in µ.

Doors: `simplified.derive_simplified`, `general.derive_general`, `optimal.derive_optimal`.  The equations are those
of `stochfuse.prediction` and the outcomes those of the engines; here they are evaluated over exact fields.  A new
formula evaluates what is written below once more, and writes no equation of its own.
"""

"""Data: records of what was measured, what arrived and what was true; run, simulate, and check a simulator.

One record of measurements and arrivals is one outcome.  `run` puts it through the estimators that the other rooms
average over chance (`stochfuse.engines.replay`), `simulate` draws such records, and `crosscheck` lays a simulator's
results beside the prediction and says what would explain a difference.

    records, writing          the files of a run, read and written
    run, consistency          estimators on records; are they as good as they claim
    innovations, suspicions   how likely a record is; what would explain that it is not
    draw, simulate            records that chance decides
    robots, robot_errors      a record of robots that see one another; how its sensors err, with memory
    robot_filters, robot_run  estimators on it, and the true errors that they should have
    tables, columns           a table from wherever it is, as NumPy columns; what is wrong by line and column
    results                   what a simulator found
    expected                  what its values are distributed like
    cells, together           each cell judged, and all of them
    crosscheck                the verdict
    mistakes, supposed        mistakes that people make, and what a simulator with one would show
    fits, causes              which of them explains a verdict that disagrees
    agent, knowledge          a live agent; what it knows, forgets and makes of it
    messages, protocols       what agents say, in bytes; load and accuracy of messages that do not carry everything

A new mistake is one entry in `mistakes.MISTAKES`.

The room knows files and the rooms below; it knows no table and no screen.
"""

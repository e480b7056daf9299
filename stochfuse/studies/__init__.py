"""Studies: one question asked of thousands to millions of points, in batches, resumable, on any executor.

    plan        what is asked: the study file's structure, points from scenario keys and settings
    reading     the study file, checked
    evaluation  the answers of some points, as items of systems
    journal     finished parts on disk, whatever happens
    files       the parts as one Parquet or CSV file, and that file read in blocks
    pareto      accuracy against message load
    running     all of it together: the door

It knows predictions and questions.  A new kind of design goes into `plan`, a new column into `evaluation`.
"""

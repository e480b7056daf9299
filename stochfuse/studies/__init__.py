"""Studies: one question asked of thousands to millions of points, in batches, resumable, on any executor.

plan        what is asked: points from scenario keys and methods
reading     the study file, checked
evaluation  the answers of some points, in batches
journal     finished parts on disk, whatever happens
writing     the parts as one Parquet or CSV file
results     that file, read in blocks
pareto      accuracy against message load
running     all of it together
"""

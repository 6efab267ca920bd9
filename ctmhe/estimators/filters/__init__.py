"""Recursive estimators: one loop over cells, inputs and samples (`filter`), and rules, a file each."""

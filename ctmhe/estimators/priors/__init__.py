"""Priors: what a prior is, the simple ones (`base`), and the rules of single schemes, a file or two each."""

"""Solvers of one window: Gauss-Newton with a structured QP, IPOPT as reference, and the ladder between them."""

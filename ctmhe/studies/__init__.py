"""Studies: published results reproduced, and the demonstration."""

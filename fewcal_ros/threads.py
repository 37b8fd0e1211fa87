"""The threads of the linear algebra that NumPy brings.

Matrices here are small, so that more threads gain nothing, and how many take part changes the last bits of a
result: with one, the node and the command give the same camera from the same frames however busy the machine
is. OpenBLAS reads the variable when NumPy is imported, which a command therefore does later.
"""

SINGLE_THREAD = ("OPENBLAS_NUM_THREADS", "1")
"""Variable and value for ``os.environ.setdefault``: whoever has set it otherwise is not overruled."""

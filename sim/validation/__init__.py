"""The validation ladder: one case a file, each a function that runs the solver at a given resolution and compares it with a reference.

A case returns {"reference", "ours", "error", "seconds"}: what the theory or experiment says, what came out, their relative difference
(or as the case says) and the wall time of the run without compilation.
"""

"""Names of the contenders that every comparison has."""

REFERENCE, FLOOR, ORACLE = "teacher", "chaos floor", "oracle"
TRIVIAL = ("frozen", "constant velocity", "ballistic", "persistent acceleration", "rigid drop")

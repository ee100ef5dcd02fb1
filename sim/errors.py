"""The one exception type that a user's own mistake raises; command lines print it as one line and exit with 2."""


class InputError(ValueError):
    """A mistake in what the user gave: names the file, the key, the value and the remedy in one line."""

    def __init__(self, where: object, key: object, value: object, remedy: str):
        shown = repr(value)
        if len(shown) > 120:
            shown = shown[:117] + "..."
        super().__init__(" ".join(f"{where}: {key} = {shown}: {remedy}".split()))


def reason(error: OSError) -> str:
    """An operating system's error in one line: the file, if it is known, and what is wrong with it."""
    text = " ".join(str(error.strerror or error).split())
    return f"{error.filename}: {text}" if error.filename else text


class RunError(RuntimeError):
    """A failure while running that is not the user's mistake (disk full, every trajectory failed): exit code 1."""

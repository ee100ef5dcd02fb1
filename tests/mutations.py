"""Damaged input, the same on every run: what a slip of the keyboard, a bad disk or an enemy makes of configurations, data and checkpoints."""

import contextlib
import copy
import datetime
import io
import json
import re
import signal
import time
from pathlib import Path

import h5py
import numpy as np
import yaml

#: What may stand where something else should. Fresh copies are dealt out, since lists can be changed.
JUNK = (
    None, True, "", "text", "1e5", "x" * 10_000, "\u2028\n\x1b[31m", -1, 0, 1, 2.5, 10**9, -(10**18), 10**30, 10**400, 1e-308, 1e308, -1e308,
    float("nan"), float("inf"), [], {}, [[]], [None], [0.5], [2, 1], [-1e308, 1e308], [float("nan")] * 2, ["a", "b"], {"a": 1}, {"a": {"b": [1]}},
    [0.5] * 100_000, {str(key): key for key in range(10_000)}, datetime.date(2020, 1, 1), b"\xff\x00",
)  # fmt: skip
#: What a number may be multiplied by.
FACTORS = (0, -1, 2, 0.5, 100, 0.01, 10**6, 1e-6, 1e20, 1e-20, 10**9)


def junk(rng):
    """One of ``JUNK``."""
    return copy.deepcopy(JUNK[rng.integers(len(JUNK))])


def places(content, prefix=()):
    """Paths of every entry of nested dicts and lists."""
    entries = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for key, value in entries:
        yield (*prefix, key)
        yield from places(value, (*prefix, key))


def spoil(content, rng, count=1):
    """A copy of nested dicts and lists in which ``count`` entries are replaced, left out, doubled, or have got a neighbour."""
    content = copy.deepcopy(content)
    for _ in range(count):
        found = list(places(content))
        if not found:
            break
        *where, last = found[rng.integers(len(found))]
        target = content
        for key in where:
            target = target[key]
        action = rng.choice(["replace", "replace", "nudge", "nudge", "leave out", "add", "swap"])
        if action == "nudge" and isinstance(target[last], int | float):
            target[last] *= FACTORS[rng.integers(len(FACTORS))]
        elif action in ("replace", "nudge"):
            target[last] = junk(rng)
        elif action == "leave out":
            del target[last]
        elif action == "add":
            target.update(colour=junk(rng)) if isinstance(target, dict) else target.append(junk(rng))
        elif isinstance(target, dict):
            target[f"{last}s"] = target.pop(last)
        else:
            target.append(copy.deepcopy(target[last]))
    return content


def _bomb(levels):
    lines = ["a0: &a0 [lol, lol, lol, lol, lol, lol, lol, lol, lol]"]
    return "\n".join(lines + [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, levels)])


def spoil_text(text, rng, mark):
    """Bytes of a YAML text after one of the things that happen to texts; ``mark`` is a folder that a tag would make."""
    lines = text.splitlines()
    keyed = [k for k, line in enumerate(lines) if re.match(r"\s*[\w ]+:", line)]
    at = int(rng.choice(keyed))
    key, _, value = lines[at].partition(":")
    bomb = _bomb(30)
    changes = {
        "truncated": lambda: text.encode()[: rng.integers(len(text.encode()))],
        "tab": lambda: "\n".join([*lines[:at], "\t" + lines[at], *lines[at + 1 :]]),
        "twice": lambda: "\n".join([*lines[: at + 1], *lines[at:]]),
        "latin": lambda: text.encode()[: rng.integers(len(text))] + b"\xe9\xff" + text.encode(),
        "nul": lambda: text[: rng.integers(len(text))] + "\x00" + text,
        "utf-16": lambda: text.encode("utf-16"),
        "bomb": lambda: "\n".join([bomb, *lines[:at], f"{key}: *a29", *lines[at + 1 :]]),
        "bomb above": lambda: "\n".join([*lines[:at], f"{key}: {{{', '.join(bomb.splitlines())}}}", *lines[at + 1 :]]),
        "merge": lambda: "\n".join([bomb, *lines, "<<: *a29"]),
        "merges": lambda: "\n".join(["m0: &m0 {x: 1}", *(f"m{k}: &m{k} {{<<: [{', '.join([f'*m{k - 1}'] * 9)}]}}" for k in range(1, 12)), *lines]),
        "itself": lambda: "\n".join([*lines[:at], f"{key}: &x [*x, {{a: *x}}]", *lines[at + 1 :]]),
        "python": lambda: "\n".join([*lines[:at], f"{key}: !!python/object/apply:os.mkdir ['{mark}']", *lines[at + 1 :]]),
        "tag": lambda: "\n".join([*lines[:at], f"{key}: {rng.choice(['!!set {a}', '!!binary aGk=', '!!omap [a: 1]', '!x y', '!!float x', '!!int '])}",
                                  *lines[at + 1 :]]),
        "deep": lambda: "\n".join([*lines[:at], f"{key}: " + "[" * 1000, *lines[at + 1 :]]),
        "nested": lambda: "\n".join([*lines[:at], f"{key}: " + "[" * 200 + "]" * 200, *lines[at + 1 :]]),
        "digits": lambda: "\n".join([*lines[:at], f"{key}: " + "9" * 5000, *lines[at + 1 :]]),
        "octal": lambda: "\n".join([*lines[:at], f"{key}: {rng.choice(['0x', '1:30:00', '0o17', '2020-13-45', '.nan', '-.inf', '~', '=', '<<'])}",
                                    *lines[at + 1 :]]),
        "odd keys": lambda: f"{text}\n{rng.choice(['1: 2', 'null: 1', '{[1, 2]: 3}', '2020-01-01: 1', '!!binary aGk=: 2', '? {a: 1}'])}",
        "documents": lambda: text + "\n---\n" + text,
        "list": lambda: "\n".join(f"- {line}" for line in lines),
        "empty": lambda: str(rng.choice(["", "\n", "#", "---", "...", "%YAML 9.9\n---\na: 1", "\ufeff", "!"])),
    }  # fmt: skip
    made = changes[str(rng.choice(list(changes)))]()
    return made if isinstance(made, bytes) else made.encode("utf-8", "surrogateescape")


def spoil_yaml(text, rng, mark):
    """Bytes of a YAML file: two in five spoilt as text, the others in one to three entries."""
    if rng.random() < 0.4:
        return spoil_text(text, rng, mark)
    return yaml.safe_dump(spoil(yaml.safe_load(text), rng, 1 + (rng.random() < 0.3)), allow_unicode=True, sort_keys=False).encode()


def told(main, *arguments):
    """Exit code and standard error of a command, run in this process. It must end in time and memory, by itself, without a traceback; what it refuses
    it refuses in one line that names file, key, value and remedy."""
    error, handler = io.StringIO(), signal.getsignal(signal.SIGTERM)
    Path("/proc/self/clear_refs").write_text("5")  # forgets the most memory that this process has had
    before, begun = _most_memory(), time.process_time()
    try:
        with contextlib.redirect_stderr(error), contextlib.redirect_stdout(io.StringIO()):
            code = main([str(argument) for argument in arguments])
    finally:
        signal.signal(signal.SIGTERM, handler)
    assert time.process_time() - begun < 10 and _most_memory() - before < 500e6
    text = error.getvalue()
    assert code in (0, 1, 2) and "Traceback" not in text, text
    if code == 2 and arguments[0] != "validate":  # which prints a line for each fault, and then how many there are
        assert re.fullmatch(r"sluice-(sim|learn): \S+: \S.* = .+: .+\n", text) and len(text) < 2000, text
    return code, text


def _most_memory():
    return int(re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())[1]) * 1024


def spoil_bytes(raw, rng, trial):
    """A binary file with one to eight bytes changed, a stretch overwritten or gone, or an end cut off; every kind in turn."""
    changed = bytearray(raw)
    if trial % 4 == 0:
        return raw[: rng.integers(len(raw))]
    if trial % 4 == 1:
        start = rng.integers(len(raw))
        end = start + 1 + rng.integers(64)
        changed[start:end] = [b"", bytes(len(changed[start:end])), rng.bytes(64)][rng.integers(3)]
        return bytes(changed)
    # Of HDF5 and zip nearly all bytes are numbers; those of the structure are few and are not zero.
    at = np.flatnonzero(np.frombuffer(raw, np.uint8)) if trial % 4 == 2 else np.arange(len(raw))
    for place in rng.choice(at[:4000] if trial % 4 == 2 else at, 1 + rng.integers(8)):
        changed[place] = rng.integers(256)
    return bytes(changed)


def _put(name, make):
    """A change of a shard's first trajectory: what ``make(old)`` gives stands for one of its data sets."""

    def change(file, index):
        old = file[index].pop(name)[()]
        file[index][name] = make(old)

    return change


def _make(name, *arguments, **options):
    """The same, made as HDF5 is told to."""

    def change(file, index):
        file[index].pop(name, None)
        file[index].create_dataset(name, *arguments, **options)

    return change


def _link(link):
    def change(file, index):
        del file[index]["position"]
        file[index]["position"] = link

    return change


def _set(which, value):
    def change(file, index):
        old = file[index]["position"][:]
        old[which] = value
        file[index]["position"][...] = old

    return change


def _rename(name):
    return lambda file, index: file.move(index, name)


def _meta(value):
    return lambda file, index: file[index].attrs.create("meta", value)


def _version(value):
    return lambda file, index: file.attrs.create("format_version", value)


def _virtual(file, index):
    layout = h5py.VirtualLayout(file[index].pop("position").shape, "f4")
    layout[:] = h5py.VirtualSource("other.h5", "000000/position", layout.shape)
    file[index].create_virtual_dataset("position", layout)


def _filtered(file, index):
    _make("position", file[index]["position"].shape, "f4", chunks=(3, 4, 2), compression=32015, allow_unknown_filter=True)(file, index)


def _packed(file, index):
    _make("position", data=file[index]["position"][:], chunks=(3, 4, 2), compression="gzip", shuffle=True)(file, index)


def _group(file, index):
    del file[index]["position"]
    file[index].create_group("position")


def _elsewhere(link):
    def change(file, index):
        file.move(index, "777777")
        file[index] = link

    return change


#: What can be wrong in a shard of 12 frames and 12 particles that is sound HDF5: (file, name of its first group) -> None.
SHARDS = {
    "doubles": _put("position", np.float64), "halves": _put("position", np.float16), "integers": _put("position", lambda old: old.astype(int)),
    "complex": _put("position", lambda old: old.astype(complex)), "big-endian": _put("position", lambda old: old.astype(">f4")),
    "text": _put("position", lambda old: "positions"), "scalar": _put("position", lambda old: np.float32(1)),
    "records": _put("position", lambda old: np.zeros(old.shape, [("x", "f4"), ("y", "f4")])),
    "texts": _make("position", (3, 4, 2), h5py.string_dtype(), data=[[["a", "b"]] * 4] * 3),
    "ragged": _make("position", (3, 4, 2), h5py.vlen_dtype("f4")), "references": _make("position", (3, 4, 2), h5py.ref_dtype),
    "nothing": _make("position", data=h5py.Empty("f4")), "one axis": _put("position", np.ravel), "four axes": _put("position", lambda old: old[None]),
    "one D": _put("position", lambda old: old[..., :1]), "four D": _put("position", lambda old: np.concatenate([old, old], 2)),
    "other D": _put("position", lambda old: old[..., [0, 1, 0]]), "no frame": _put("position", lambda old: old[:0]),
    "a frame": _put("position", lambda old: old[:1]), "two frames": _put("position", lambda old: old[:2]),
    "no particle": _put("position", lambda old: old[:, :0]), "a particle less": _put("position", lambda old: old[:, 1:]),
    "nan": _set((2, 1, 0), np.nan), "all nan": _set((), np.nan), "inf": _set((1, 0, 1), np.inf), "far": _set((2, 1, 0), 3e38),
    "very far": _set((2, 1), -1e30), "far apart": _set((slice(None), 0), 1e6), "tiny": _set((), 1e-45), "in one place": _set((), 0.5),
    "no types": _put("particle_type", lambda old: old[:0]), "type 9": _put("particle_type", lambda old: old + 9),
    "type -1": _put("particle_type", lambda old: old * 0 - 1), "type 2": _put("particle_type", lambda old: old * 0 + 2),
    "all still": _put("particle_type", lambda old: old * 0 + 3), "types of floats": _put("particle_type", lambda old: old + 0.5),
    "wide types": _put("particle_type", lambda old: old.astype(np.int64) + 2**40), "bool types": _put("particle_type", lambda old: old > 0),
    "types of text": _put("particle_type", lambda old: ["5"] * len(old)), "types in columns": _put("particle_type", lambda old: old[:, None]),
    "context of text": _make("context", data=["a"] * 12), "context of nan": _make("context", data=np.full((12, 2), np.nan, np.float32)),
    "short context": _make("context", data=np.zeros((5, 2), np.float32)), "context": _make("context", data=np.zeros((12, 2), np.float32)),
    "context of nothing": _make("context", data=np.zeros((12, 0), np.float32)), "flat context": _make("context", data=np.zeros(12)),
    "huge": _make("position", (10**6, 10**6, 2), "f4"), "huge types": _make("particle_type", (10**12,), "i1", chunks=(1000,)),
    "huge, of zeros": _make("position", (10**5, 10**5, 2), "f4", chunks=(10, 10, 2), compression="gzip"),
    "huge context": _make("context", (10**7, 10**6), "f4"), "huge diagnostics": _make("diagnostics/energy", (10**13,), "f8", chunks=(100,)),
    "diagnostics of text": _make("diagnostics/energy", data=["a"] * 12), "diagnostics": _make("diagnostics/energy", data=np.arange(12.0)),
    "diagnostics a data set": _make("diagnostics", data=[1.0]),
    "diagnostics in groups": lambda file, index: file[index].create_group("diagnostics/a/b"),
    "packed": _packed, "filter of others": _filtered, "position a group": _group, "virtual": _virtual,
    "external link": _link(h5py.ExternalLink("other.h5", "000000/position")), "link to a device": _link(h5py.ExternalLink("/dev/zero", "x")),
    "link to itself": _link(h5py.SoftLink("position")), "link to nothing": _link(h5py.SoftLink("/nothing")), "link up": _link(h5py.SoftLink("/")),
    "external storage": _make("position", (12, 12, 2), "f4", external=[("/etc/passwd", 0, h5py.h5f.UNLIMITED)]),
    "group a data set": lambda file, index: (file.pop(index), file.create_dataset(index, data=[1.0])),
    "group a link": _elsewhere(h5py.SoftLink("777777")), "group elsewhere": _elsewhere(h5py.ExternalLink("other.h5", "000000")),
    "group in itself": lambda file, index: file[index].__setitem__("self", file[index]),
    "group more": lambda file, index: file.create_group("000077"),
    "group of a word": _rename("zero"), "group below zero": _rename("-1"), "group of digits": _rename("9" * 5000), "group unpadded": _rename("0"),
    "group of other digits": _rename("\u0661"), "no group": lambda file, index: file.pop(index), "nothing left": lambda file, index: file.clear(),
    "no position": lambda file, index: file[index].pop("position"), "no particle_type": lambda file, index: file[index].pop("particle_type"),
    "no meta": lambda file, index: file[index].attrs.pop("meta"), "meta of bytes": _meta(np.void(b"\xff\x00")),
    "meta of numbers": _meta(np.arange(5)), "meta of nothing": _meta(h5py.Empty("f4")), "meta of texts": _meta(["{}"] * 3),
    "deep meta": _meta("[" * 20_000),
    "latin meta": _meta(np.bytes_(b'{"a": "\xe9"}')), "no version": lambda file, index: file.attrs.pop("format_version"), "version 2": _version(2),
    "version of text": _version("one"), "versions": _version([1, 1]), "version nan": _version(np.nan), "version of bytes": _version(np.void(b"1")),
}  # fmt: skip
#: Those among them that are sound data, though perhaps not what every reader wants.
SOUND = ("packed", "group in itself", "context", "diagnostics", "type 9", "type -1", "type 2", "wide types", "all still", "in one place",
         "two frames", "a frame", "no group", "nothing left", "version of bytes")  # fmt: skip


def change_shard(path, case):
    """Make one of ``SHARDS`` of a shard where it lies."""
    with h5py.File(path, "r+") as file:
        SHARDS[case](file, min(file))


def spoil_shard(path, rng, trial):
    """Spoil a shard where it lies: its bytes, or what its ``meta`` says."""
    if trial % 2:
        with h5py.File(path, "r+") as file:
            group = file[min(file)]
            group.attrs.modify("meta", json.dumps(spoil(json.loads(group.attrs["meta"]), rng), default=str))
    else:
        path.write_bytes(spoil_bytes(path.read_bytes(), rng, trial // 2))


def spoil_json(text, rng, trial):
    """A JSON file spoilt as bytes (one in four) or in one entry."""
    if trial % 4 == 0:
        return spoil_bytes(text.encode(), rng, trial // 4)
    return json.dumps(spoil(json.loads(text), rng), default=str).encode()

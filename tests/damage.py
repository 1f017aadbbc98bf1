"""Damaged, shortened, exchanged and missing files."""

import random


def damaged(path, other=None, flips=20):
    """Damage a file in one way after another: flipped bits, truncations, the content of another file, a missing file.

    An empty file gets a byte instead. Yields the kind of each damage while the file has it. At the end, the file is as
    before.
    """
    data, chance = path.read_bytes(), random.Random(0)
    if not data:
        path.write_bytes(b"x")
        yield "not empty"
    for place in (0, len(data) - 2, *(chance.randrange(len(data)) for _ in range(flips))) if data else ():
        path.write_bytes(data[:place] + bytes([data[place] ^ 1 << chance.randrange(8)]) + data[place + 1 :])
        yield "flipped"
    for size in sorted({0, min(10, len(data) - 1), max(len(data) - 3, 0)}) if data else ():
        path.write_bytes(data[:size])
        yield "truncated"
    if other is not None:
        path.write_bytes(other.read_bytes())
        yield "exchanged"
    path.unlink()
    yield "missing"
    path.write_bytes(data)

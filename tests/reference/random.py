"""The random numbers of `core.random`, one at a time in Python's integers, from the definition of splitmix64."""

WORD = 1 << 64
GAMMA = 0x9E3779B97F4A7C15


def mix(z: int) -> int:
    """The output function of splitmix64 (Steele, Lea, Flood, OOPSLA 2014)."""
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9 % WORD
    z = (z ^ (z >> 27)) * 0x94D049BB133111EB % WORD
    return z ^ (z >> 31)


def number(seed: int, key: int, stream: int, draw: int, column: int, columns: int) -> int:
    """The 63-bit number in one column of one draw."""
    seed_word = mix(((2 * seed + 1) * GAMMA + stream) % WORD)
    start = mix((key % WORD) ^ seed_word)
    return mix((start + (draw * columns + column) * GAMMA) % WORD) >> 1

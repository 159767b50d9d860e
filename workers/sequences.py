"""Low-discrepancy points for the first vertex of a baked path: an Owen-shuffled (0, 2)-sequence for each pair.

Of every aligned run of 2^k points each pair fills every elementary interval of area 2^-k once: the samples of a
texel are stratified, those of neighbouring elements fill each other's gaps, and the average that denoises the caches
is one of well-spread points. Pairs are padded: each has a shuffle of its own (Burley 2020, Practical Hash-based Owen
Scrambling, with the hash of Laine and Karras 2011), so that they are independent of each other.
"""

from workers.backend import dr, mi

_GOLDEN = 0x9E3779B9


class PaddedPoints:
    """Points of one index in as many sequences as are asked for; every lane has its own index and seed.

    Args:
        index: of the point, uint32 lanes; those that are averaged should be consecutive.
        seed: of the sequences, uint32 lanes; equal for points that should complete each other.
    """

    def __init__(self, index: "mi.UInt32", seed: "mi.UInt32") -> None:
        self._index, self._seed, self._num_asked = index, seed, 0

    def next_2d(self) -> "mi.Point2f":
        """The point of the next sequence, in [0, 1)^2."""
        self._num_asked += 1
        salt = dr.opaque(mi.UInt32, (self._num_asked * _GOLDEN) & 0xFFFFFFFF)
        shuffle, scramble = mi.sample_tea_32(self._seed, salt, 4)
        index = nested_uniform_scramble(self._index, shuffle)
        low, high = scramble * 0x85EBCA6B, scramble * 0xC2B2AE35 ^ shuffle
        return mi.Point2f(mi.radical_inverse_2(index, low), mi.sobol_2(index, high))

    def next_1d(self) -> "mi.Float":
        """A number of the next sequence, in [0, 1)."""
        return self.next_2d().x


def nested_uniform_scramble(value: "mi.UInt32", seed: "mi.UInt32") -> "mi.UInt32":
    """Owen's scramble in base 2: a permutation that keeps aligned blocks of 2^k numbers together."""
    value = dr.brev(value) + seed
    for factor in (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6):
        value ^= value * mi.UInt32(factor)
    return dr.brev(value)

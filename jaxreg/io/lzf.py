"""LZF, the compression of binary PCD files."""


def unpacked(packed: bytes, size: int) -> bytes:
    """At most about `size` bytes, of runs of literals and references to what stands before.

    Empty where the data are damaged.
    """
    result, i = bytearray(), 0
    try:
        while i < len(packed) and len(result) <= size:
            control = packed[i]
            i += 1
            if control < 32:
                result += packed[i : i + control + 1]
                i += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += packed[i]
                i += 1
            start = len(result) - ((control & 31) << 8) - packed[i] - 1
            i += 1
            if start < 0:
                return b""
            for offset in range(start, start + length + 2):  # may run into what it appends
                result.append(result[offset])
    except IndexError:
        return b""
    return bytes(result)

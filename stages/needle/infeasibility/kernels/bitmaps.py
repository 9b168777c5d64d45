"""Sets of cells of a plane as bitmaps: moved, widened, united, halved."""

import math

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel

ONE = np.uint64(1)
ALL = np.uint64(0xFFFFFFFFFFFFFFFF)


@inner_kernel
def _shift(dx):
    """Return a move by cells as whole words and the rest in bits, with the shifts of a word and its carry."""
    step = dx // 64
    rest = dx - 64 * step
    return step, rest, np.uint64(rest), np.uint64(64 - rest)


@kernel(nogil=True)
def or_shifted(target, source, dy, dx):
    """OR a bitmap into another one, moved by whole cells; what falls off is dropped."""
    rows, words = source.shape
    to_rows, to_words = target.shape
    step, rest, low, high = _shift(dx)
    for y in range(max(0, -dy), min(rows, to_rows - dy)):
        for w in range(words):
            value = source[y, w]
            if value == 0:
                continue
            to = w + step
            if 0 <= to < to_words:
                target[y + dy, to] |= value << low
            if rest and 0 <= to + 1 < to_words:
                target[y + dy, to + 1] |= value >> high


@kernel(nogil=True)
def and_shifted(target, source, dy, dx):
    """Keep of a bitmap what another one, moved by whole cells, holds; beyond its edge is nothing."""
    rows, words = source.shape
    to_rows, to_words = target.shape
    step, rest, low, high = _shift(dx)
    for y in range(to_rows):
        from_y = y - dy
        for to in range(to_words):
            if target[y, to] == 0:
                continue
            value = np.uint64(0)
            if 0 <= from_y < rows:
                w = to - step
                if 0 <= w < words:
                    value = source[from_y, w] << low
                if rest and 0 <= w - 1 < words:
                    value |= source[from_y, w - 1] >> high
            target[y, to] &= value


@kernel(nogil=True)
def spread(target, source, first, last, width, shift, scratch):
    """Set a row of words to another one, each bit spread by `width` cells to both sides and moved by `shift`.

    Only the words `first` to `last` of the source are used.  `scratch` is longer than the source by
    `2 width` bits and a word.
    """
    end = last + (2 * width + 63) // 64 + 1
    for w in range(first, end):
        scratch[w] = source[w] if w <= last else np.uint64(0)
    # To the right by doubling, so that each bit covers 2 width + 1 cells.
    covered = 1
    while covered < 2 * width + 1:
        by = min(covered, 2 * width + 1 - covered)
        step = by // 64
        rest = np.uint64(by - 64 * step)
        for w in range(end - 1, first + step - 1, -1):
            value = scratch[w - step] << rest
            if rest and w - step - 1 >= first:
                value |= scratch[w - step - 1] >> (np.uint64(64) - rest)
            scratch[w] |= value
        covered += by
    step = (shift - width) // 64
    rest = np.uint64(shift - width - 64 * step)
    for to in range(target.shape[0]):
        w = to - step
        value = np.uint64(0)
        if first <= w < end:
            value = scratch[w] << rest
        if rest and first <= w - 1 < end:
            value |= scratch[w - 1] >> (np.uint64(64) - rest)
        target[to] = value


@merged_kernel
def dilate(target, source, box, square, disc, dy, dx, scratch, row):
    """OR a bitmap into another, moved by whole cells, dilated by a square of half side `square` and a disc.

    Both in cells, any fraction.  A cell is reached if its centre is: the caller adds what a cell is wide.

    Args:
        target, source: (Y, W), (Y', W') uint64.
        box ((4,) int64): First and last row, first and last word of the source that count.
        dy, dx (int): The move, in cells.
        scratch, row ((S,), (W,) uint64): Workspace; see `spread`.
    """
    to_rows = target.shape[0]
    reach = int(math.floor(square + disc))
    for y in range(box[0], box[1] + 1):
        last = -1
        first_word, last_word = box[2], box[3]
        while first_word <= last_word and source[y, first_word] == 0:
            first_word += 1
        while last_word >= first_word and source[y, last_word] == 0:
            last_word -= 1
        if last_word < first_word:
            continue
        for side in range(reach, -1, -1):
            beyond = max(side - square, 0.0)
            width = int(math.floor(square + math.sqrt(max(disc * disc - beyond * beyond, 0.0))))
            above = y + dy + side
            below = y + dy - side
            if not 0 <= above < to_rows and not 0 <= below < to_rows:
                continue
            if width != last:
                spread(row, source[y], first_word, last_word, width, dx, scratch)
                last = width
            if 0 <= above < to_rows:
                for w in range(row.shape[0]):
                    target[above, w] |= row[w]
            if side > 0 and 0 <= below < to_rows:
                for w in range(row.shape[0]):
                    target[below, w] |= row[w]


@inner_kernel
def find_box(bitmap, box):
    """Fill `box` (4,) with the first and last row and word in use; return whether there is any bit."""
    rows, words = bitmap.shape
    box[0], box[1], box[2], box[3] = rows, -1, words, -1
    for y in range(rows):
        for w in range(words):
            if bitmap[y, w] != 0:
                box[0] = min(box[0], y)
                box[1] = y
                box[2] = min(box[2], w)
                box[3] = max(box[3], w)
    return box[1] >= 0


@inner_kernel
def or_box(target, target_box, source, box):
    """OR one bitmap into another within the box of the first, which is added to that of the other."""
    if box[1] < box[0]:
        return
    for y in range(box[0], box[1] + 1):
        for w in range(box[2], box[3] + 1):
            target[y, w] |= source[y, w]
    if target_box[1] < target_box[0]:
        for m in range(4):
            target_box[m] = box[m]
        return
    for m in range(0, 4, 2):
        target_box[m] = min(target_box[m], box[m])
        target_box[m + 1] = max(target_box[m + 1], box[m + 1])


@kernel(nogil=True)
def extent(states, out):
    """Fill `out` (8,) with the first and last direction row, column, position row and word in use."""
    nv, nu, _rows, _words = states.shape
    out[0::2] = 1 << 40
    out[1::2] = -1
    box = np.zeros(4, np.int64)
    for v in range(nv):
        for u in range(nu):
            if find_box(states[v, u], box):
                out[0] = min(out[0], v)
                out[1] = max(out[1], v)
                out[2] = min(out[2], u)
                out[3] = max(out[3], u)
                for m in range(0, 4, 2):
                    out[4 + m] = min(out[4 + m], box[m])
                    out[5 + m] = max(out[5 + m], box[m + 1])


@kernel(nogil=True)
def refine(coarse, halve_slopes, out):
    """Set the cells that overlap or touch a cell, twice as wide, that is set in `coarse` (V, U, Y, W).

    `out` is (2 V + 1, 2 U + 1, 2 Y + 1, 2 W + 1) and starts at twice the cell number less one.  Unless
    `halve_slopes`, the cells of directions stay, and so do the first two numbers of shape and start.
    """
    nv, nu, rows, words = coarse.shape
    box = np.zeros(4, np.int64)
    wide = np.zeros((2 * rows + 1, 2 * words + 1), np.uint64)
    for v in range(nv):
        for u in range(nu):
            if not find_box(coarse[v, u], box):
                continue
            wide[:] = 0
            for y in range(box[0], box[1] + 1):
                for w in range(2 * box[2], 2 * box[3] + 2):
                    value = _every_other(coarse[v, u, y, w // 2] >> np.uint64(32 * (w % 2)))
                    beyond = value >> np.uint64(62)
                    value |= value << ONE | value << np.uint64(2)
                    for to in range(2 * y, 2 * y + 3):
                        wide[to, w] |= value
                        wide[to, w + 1] |= beyond
            for to_v in range(2 * v if halve_slopes else v, 2 * v + 3 if halve_slopes else v + 1):
                for to_u in range(2 * u if halve_slopes else u, 2 * u + 3 if halve_slopes else u + 1):
                    for y in range(2 * box[0], 2 * box[1] + 3):
                        for w in range(2 * box[2], 2 * box[3] + 3):
                            out[to_v, to_u, y, w] |= wide[y, w]


@merged_kernel
def _every_other(word):
    """Return the lower 32 bits of a word, moved to its even places."""
    word &= np.uint64(0xFFFFFFFF)
    word = (word | (word << np.uint64(16))) & np.uint64(0x0000FFFF0000FFFF)
    word = (word | (word << np.uint64(8))) & np.uint64(0x00FF00FF00FF00FF)
    word = (word | (word << np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    word = (word | (word << np.uint64(2))) & np.uint64(0x3333333333333333)
    return (word | (word << ONE)) & np.uint64(0x5555555555555555)

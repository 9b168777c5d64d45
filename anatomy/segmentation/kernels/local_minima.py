"""Grey-scale closing and reconstruction of one slice: how deep every pixel lies in a local minimum.

A slice is `(rows, columns)` int16, C-contiguous; the structuring element is the pixel and its four
neighbours.  What lies beyond the border takes no part in a minimum or maximum.
"""

import numpy as np

from anatomy.kernels.compiling import kernel


@kernel(nogil=True)
def smooth_slice(image, out):
    """Write the rounded mean of every pixel and its neighbours within the slice."""
    rows, columns = image.shape
    for r in range(rows):
        for c in range(columns):
            total = np.int32(image[r, c])
            count = np.int32(1)
            if r > 0:
                total += image[r - 1, c]
                count += 1
            if r < rows - 1:
                total += image[r + 1, c]
                count += 1
            if c > 0:
                total += image[r, c - 1]
                count += 1
            if c < columns - 1:
                total += image[r, c + 1]
                count += 1
            out[r, c] = np.int16(np.floor(total / count + 0.5))


def _over_neighbours(extreme):
    """Return the kernel that writes the extreme, `max` or `min`, of every pixel and its neighbours."""

    @kernel(nogil=True)
    def filter_slice(image, out):
        rows, columns = image.shape
        for r in range(rows):
            above = image[max(r - 1, 0)]
            here = image[r]
            below = image[min(r + 1, rows - 1)]
            target = out[r]
            for c in range(columns):
                target[c] = extreme(here[c], extreme(above[c], below[c]))
            for c in range(columns - 1):
                target[c] = extreme(target[c], here[c + 1])
            for c in range(1, columns):
                target[c] = extreme(target[c], here[c - 1])

    return filter_slice


dilate_slice = _over_neighbours(max)
erode_slice = _over_neighbours(min)


@kernel(nogil=True)
def reconstruct_slice(marker, mask, queue, waiting):
    """Lower `marker` in place to its reconstruction by erosion above `mask`.

    `marker >= mask` everywhere.  The result is the limit of `max(erode(marker), mask)`.  One scan each
    way and a queue of what still changes [Vincent1993]; `queue` is `(rows * columns + 1,)` int32 and
    `waiting` `(rows, columns)` bool, false, and false again afterwards.  No pixel waits twice, so the ring
    of the queue, one longer than there are pixels, cannot run into its own head.  A slice has less than
    2^31 pixels.
    """
    rows, columns = mask.shape
    for r in range(rows):
        for c in range(columns):
            value = marker[r, c]
            if r > 0:
                value = min(value, marker[r - 1, c])
            if c > 0:
                value = min(value, marker[r, c - 1])
            marker[r, c] = max(value, mask[r, c])
    size = rows * columns + 1
    head = 0
    tail = 0
    for r in range(rows - 1, -1, -1):
        for c in range(columns - 1, -1, -1):
            value = marker[r, c]
            if r < rows - 1:
                value = min(value, marker[r + 1, c])
            if c < columns - 1:
                value = min(value, marker[r, c + 1])
            value = max(value, mask[r, c])
            marker[r, c] = value
            if (r < rows - 1 and marker[r + 1, c] > value and marker[r + 1, c] > mask[r + 1, c]) or (
                c < columns - 1 and marker[r, c + 1] > value and marker[r, c + 1] > mask[r, c + 1]
            ):
                queue[tail] = r * columns + c
                tail += 1
                waiting[r, c] = True
    while head != tail:
        at = queue[head]
        head = head + 1 if head + 1 < size else 0
        r = at // columns
        c = at - r * columns
        value = marker[r, c]
        waiting[r, c] = False
        for n in range(4):
            y = r + (1 if n == 0 else (-1 if n == 1 else 0))
            x = c + (1 if n == 2 else (-1 if n == 3 else 0))
            if 0 <= y < rows and 0 <= x < columns and marker[y, x] > value and marker[y, x] > mask[y, x]:
                marker[y, x] = max(value, mask[y, x])
                if not waiting[y, x]:
                    waiting[y, x] = True
                    queue[tail] = y * columns + x
                    tail = tail + 1 if tail + 1 < size else 0


@kernel(nogil=True)
def depth_slice(image, scale, work, queue, waiting, out):
    """Write how much higher the closing of `image` by `scale` diamonds, reconstructed, lies than `image`.

    `work` is `(2, rows, columns)` int16; `queue` and `waiting` as for `reconstruct_slice`.
    """
    a = work[0]
    b = work[1]
    a[:, :] = image
    for _ in range(scale):
        dilate_slice(a, b)
        a, b = b, a
    for _ in range(scale):
        erode_slice(a, b)
        a, b = b, a
    reconstruct_slice(a, image, queue, waiting)
    rows, columns = image.shape
    for r in range(rows):
        for c in range(columns):
            out[r, c] = a[r, c] - image[r, c]

"""Float64 twin of stereo matching: census, costs and semi-global matching written with loops; imports nothing of ours."""

import numpy as np


def census_bits(image, reach_x, reach_y):
    """[rows, cols, bits] bool: which neighbours are darker; pixels beyond the border are those at the border."""
    rows, cols = image.shape
    bits = []
    for dy in range(-reach_y, reach_y + 1):
        for dx in range(-reach_x, reach_x + 1):
            if dx or dy:
                y, x = np.clip(np.arange(rows) + dy, 0, rows - 1), np.clip(np.arange(cols) + dx, 0, cols - 1)
                bits.append(image[np.ix_(y, x)] < image)
    return np.stack(bits, axis=-1)


def costs(left, right, seen, disparities, reach_x, reach_y, chance):
    """[rows, cols, disparities] mean count of differing bits over frames; `chance` where there is nothing to compare with."""
    frames, rows, cols = left.shape
    found = np.full((rows, cols, len(disparities)), float(chance))
    ours = [census_bits(image, reach_x, reach_y) for image in left]
    theirs = [census_bits(image, reach_x, reach_y) for image in right]
    for number, disparity in enumerate(disparities):
        for c in range(cols):
            x = c - disparity
            if 0 <= x < right.shape[2]:
                differ = sum((a[:, c] != b[:, x]).sum(axis=-1) for a, b in zip(ours, theirs, strict=True)) / frames
                found[:, c, number] = np.where(seen[:, x], differ, chance)
    return found


def path_sums(volume, directions, small, large):
    """[rows, cols, disparities] sum over directions (down, across) of the least costs of paths (Hirschmüller 2008, eq. 13 and 14)."""
    rows, cols, _count = volume.shape
    total = np.zeros_like(volume, dtype=np.float64)
    for down, across in directions:
        path = np.zeros_like(total)
        for r in range(rows) if down >= 0 else range(rows - 1, -1, -1):
            for c in range(cols) if across >= 0 else range(cols - 1, -1, -1):
                before_r, before_c = r - down, c - across
                path[r, c] = volume[r, c]
                if 0 <= before_r < rows and 0 <= before_c < cols:
                    before = path[before_r, before_c]
                    beside = np.minimum(np.append(before[1:], np.inf), np.insert(before[:-1], 0, np.inf)) + small
                    path[r, c] += np.minimum(np.minimum(before, beside), before.min() + large) - before.min()
        total += path
    return total

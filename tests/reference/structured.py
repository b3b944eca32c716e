"""Decoders of projected codes in float64 NumPy: slow, plain, and sharing nothing with the kernels."""

import itertools

import numpy as np


def gray_number(bits):
    """Number of a Gray code; bits [n, pixels] bool, bit 0 first."""
    number = np.zeros(bits.shape[1], dtype=int)
    parity = np.zeros(bits.shape[1], dtype=int)
    for bit in reversed(range(len(bits))):
        parity ^= bits[bit].astype(int)
        number += parity << bit
    return number


def stripes(direct, inverse, white, black, read, gain, code="gray", base_bit=0, shadow=5.0, doubt=3.0, part=0.05, spread=1, free=2):
    """Least and greatest stripe of each pixel, the width that its deviation stands for, and a status name; readings [bits, pixels], bit 0
    first."""
    pixels, n = direct.shape[1], len(direct)
    if white is None:
        contrast = np.abs(direct - inverse).max(axis=0)
        variance = 2 * read**2 + gain * np.maximum(direct[-1] + inverse[-1], 0)
    else:
        contrast = white - black
        variance = 2 * read**2 + gain * (np.maximum(white, 0) + np.maximum(black, 0))
    if inverse is None:
        difference = direct - (white + black) / 2
        own = read**2 + gain * np.maximum(direct, 0) + variance / 4
        small, factor = part * contrast / 2, 2
    else:
        difference = direct - inverse
        own = 2 * read**2 + gain * np.maximum(direct + inverse, 0)
        small, factor = part * contrast, 1
    shown = difference > 0
    limit = np.maximum(doubt**2 * own, small**2)
    doubtful = ~(difference**2 >= limit)
    faint = ~(difference**2 >= np.maximum(4 * limit, (contrast / 4 / factor)**2))
    highest = np.where(faint.any(axis=0), n - 1 - faint[::-1].argmax(axis=0), -1)
    uncertain = doubtful.any(axis=0)
    size = factor * np.abs(difference)
    alone = size.max(axis=0) if code == "xor" or n == 1 else np.max([(a + b) / 2 for a, b in itertools.pairwise(size[:3])], axis=0)
    stray = np.maximum(contrast - 2 * alone, 0)
    if code == "xor":
        unproven = np.broadcast_to(~(stray < 0.5 * contrast), size.shape)
    else:
        unproven = ~(size >= stray) & (np.arange(n) >= 2)[:, None]
        if code == "binary":
            unproven = (unproven & ~(size + factor * np.sqrt(limit) >= stray) & ~(stray < 0.5 * contrast)
                        & ~((size - size[0])**2 < 4 * np.maximum(factor**2 * limit, 0.01 * contrast**2)))
    doubtful = doubtful | unproven
    carry = ((faint == (np.arange(n)[:, None] <= highest)).all(axis=0) & (highest >= 1) & uncertain & ~(doubtful & ~faint).any(axis=0)
             & (code == "binary") & (contrast**2 >= (3 * doubt) ** 2 * variance * (1 if inverse is not None else 3)))
    free = min(free, {"binary": 0, "gray": n - 1, "xor": base_bit}[code])
    loose = np.minimum(np.maximum(doubt * np.sqrt(variance), stray) / np.maximum(contrast, 1e-20), 1)
    least, most, status = np.zeros(pixels, int), np.zeros(pixels, int), np.full(pixels, "OK", dtype=object)
    for p in range(pixels):
        if not (contrast[p] > 0 and contrast[p] ** 2 >= shadow**2 * variance[p]):
            status[p] = "SHADOWED"
            continue
        if carry[p]:
            wide = 1 << (highest[p] + 1)
            edge = sum(int(b) << i for i, b in enumerate(shown[:, p])) // wide * wide + wide // 2
            least[p], most[p] = (edge - wide // 2, edge + wide // 2 - 1) if wide <= 8 else (edge - 1, edge)
            continue
        left = 0
        while left < free and doubtful[left, p]:
            left += 1
        if unproven[left:, p].sum() > 2:
            status[p] = "MULTIPATH"
            continue
        where = left + np.flatnonzero(doubtful[left:, p])
        if len(where) > 2:
            status[p] = "UNDECIDED"
            continue
        numbers = []
        for choice in itertools.product((False, True), repeat=len(where)):
            bits = shown[:, p].copy()
            bits[where[np.array(choice, dtype=bool)]] ^= True
            if code == "xor":
                bits[base_bit + 1:] ^= bits[base_bit]
            number = sum(int(b) << i for i, b in enumerate(bits)) if code == "binary" else int(gray_number(bits[:, None])[0])
            numbers.append(number >> left)
        least[p], most[p] = min(numbers) << left, ((max(numbers) + 1) << left) - 1
        if max(numbers) - min(numbers) > spread:
            status[p] = "UNDECIDED"
    width = np.where(most - least == 1, 1 + loose, most - least + 1)
    return least, most, width, status


def phase(readings, shifts):
    """Phase in 0…2π, amplitude, offset of [frames, pixels] at shifts in turns, by numpy's least squares."""
    angles = 2 * np.pi * np.asarray(shifts)
    design = np.stack([np.ones_like(angles), np.cos(angles), np.sin(angles)], axis=1)
    (a, c, s), *_ = np.linalg.lstsq(design, readings, rcond=None)
    return np.arctan2(s, c) % (2 * np.pi), np.hypot(c, s), a


def unwrap(phases, sigmas, periods, extent, step=0.02):
    """The place of least χ² by exhaustive search on a grid; phases [periods, pixels]."""
    u = np.arange(0, extent, step)
    best, place = np.full(phases.shape[1], np.inf), np.zeros(phases.shape[1])
    expected = 2 * np.pi * u[:, None] / np.asarray(periods)
    for p in range(phases.shape[1]):
        miss = np.angle(np.exp(1j * (expected - phases[:, p]))) / sigmas[:, p]
        cost = (miss**2).sum(axis=1)
        at = int(np.argmin(cost))
        best[p], place[p] = cost[at], u[at]
    return place, best


def kary_number(digits, base, reflected):
    """Stripe number of digits [n, pixels], digit 0 first: found by trying every stripe."""
    n = len(digits)
    table = []
    for number in range(base**n):
        plain = [number // base**d % base for d in range(n)]
        shown = [base - 1 - t if reflected and number // base ** (d + 1) % 2 else t for d, t in enumerate(plain)]
        table.append(shown)
    table = np.array(table)
    return np.array([int(np.flatnonzero((table == column).all(axis=1))[0]) for column in digits.T])


def kary_digits(readings, white, black, expected):
    """Nearest level of [digits, channels, pixels], as a part of white minus black."""
    part = (readings - black) / (white - black)
    distance = ((part[:, None] - expected[None, :, :, None]) ** 2 * (white - black) ** 2).sum(axis=2)
    return distance.argmin(axis=1)

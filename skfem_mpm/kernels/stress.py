"""Stress at the points: turning it with the spin of the step, then the law, branch-free over component rows.

``grad`` comes in with the rows of the displacement gradient and is used up: turning leaves the packed strain increment
in it; ``first`` is the point in its first column.  Each law counts the points whose stress is not finite.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from .options import INLINE, OPTIONS, TILE

U = np.uint64


@njit(**OPTIONS)
def _turn1(sigma, grad, first, volume, hoop, p0, p1):
    bad = 0
    for q in range(p0, p1):
        p, g = U(q), U(q - first)
        ratio = 1 + grad[0, g]
        if hoop:
            ring = 1 + grad[1, g]
            ratio = ratio * ring if ring > 0 else -abs(ratio * ring)
            grad[2, g], grad[1, g], grad[3, g] = grad[1, g], 0.0, 0.0
        volume[p] *= ratio
        bad += not ratio > 0
    return bad


@njit(**OPTIONS)
def _turn2(sigma, grad, first, volume, hoop, p0, p1):
    bad = 0
    for q in range(p0, p1):
        p, g = U(q), U(q - first)
        xx, xy, yx, yy = grad[0, g], grad[1, g], grad[2, g], grad[3, g]
        a = (xy - yx) / 4
        scale = 1 / (1 + a * a)
        c, s = (1 - a * a) * scale, 2 * a * scale
        sxx, syy, sxy = sigma[0, p], sigma[1, p], sigma[3, p]
        cc, ss, cs = c * c, s * s, c * s
        sigma[0, p] = cc * sxx + 2 * cs * sxy + ss * syy
        sigma[1, p] = ss * sxx - 2 * cs * sxy + cc * syy
        sigma[3, p] = cs * (syy - sxx) + (cc - ss) * sxy
        ratio = (1 + xx) * (1 + yy) - xy * yx
        grad[1, g], grad[3, g] = yy, (xy + yx) / 2
        if hoop:
            ring = 1 + grad[4, g]
            ratio = ratio * ring if ring > 0 else -abs(ratio * ring)
            grad[2, g] = grad[4, g]
        else:
            grad[2, g] = 0.0
        volume[p] *= ratio
        bad += not ratio > 0
    return bad


@njit(**INLINE)
def _rotation(a, b, c):
    """Cayley's rotation of the antisymmetric tensor with components xy = a, yz = b, xz = c."""
    scale = 2 / (1 + a * a + b * b + c * c)
    return (1 - scale * (a * a + c * c), scale * (a - b * c), scale * (c + a * b),
            scale * (-a - b * c), 1 - scale * (a * a + b * b), scale * (b - a * c),
            scale * (-c + a * b), scale * (-b - a * c), 1 - scale * (b * b + c * c))


@njit(**OPTIONS)
def _turn3(sigma, grad, first, volume, hoop, p0, p1):
    bad = 0
    for q in range(p0, p1):
        p, g = U(q), U(q - first)
        xx, xy, xz = grad[0, g], grad[1, g], grad[2, g]
        yx, yy, yz = grad[3, g], grad[4, g], grad[5, g]
        zx, zy, zz = grad[6, g], grad[7, g], grad[8, g]
        r00, r01, r02, r10, r11, r12, r20, r21, r22 = _rotation((xy - yx) / 4, (yz - zy) / 4, (xz - zx) / 4)
        s0, s1, s2, s3, s4, s5 = sigma[0, p], sigma[1, p], sigma[2, p], sigma[3, p], sigma[4, p], sigma[5, p]
        a0, a1, a2 = r00 * s0 + r01 * s3 + r02 * s5, r00 * s3 + r01 * s1 + r02 * s4, r00 * s5 + r01 * s4 + r02 * s2
        b0, b1, b2 = r10 * s0 + r11 * s3 + r12 * s5, r10 * s3 + r11 * s1 + r12 * s4, r10 * s5 + r11 * s4 + r12 * s2
        c0, c1, c2 = r20 * s0 + r21 * s3 + r22 * s5, r20 * s3 + r21 * s1 + r22 * s4, r20 * s5 + r21 * s4 + r22 * s2
        sigma[0, p] = a0 * r00 + a1 * r01 + a2 * r02
        sigma[1, p] = b0 * r10 + b1 * r11 + b2 * r12
        sigma[2, p] = c0 * r20 + c1 * r21 + c2 * r22
        sigma[3, p] = a0 * r10 + a1 * r11 + a2 * r12
        sigma[4, p] = b0 * r20 + b1 * r21 + b2 * r22
        sigma[5, p] = a0 * r20 + a1 * r21 + a2 * r22
        ratio = ((1 + xx) * ((1 + yy) * (1 + zz) - yz * zy) - xy * (yx * (1 + zz) - yz * zx)
                 + xz * (yx * zy - (1 + yy) * zx))
        grad[0, g], grad[1, g], grad[2, g] = xx, yy, zz
        grad[3, g], grad[4, g], grad[5, g] = (xy + yx) / 2, (yz + zy) / 2, (xz + zx) / 2
        volume[p] *= ratio
        bad += not ratio > 0
    return bad


@njit(**OPTIONS)
def _elastic(strain, first, sigma, lam, twice, rows, p0, p1):
    bad = 0
    for q in range(p0, p1):
        p, g = U(q), U(q - first)
        trace = strain[0, g]
        if len(rows) > 1:
            trace += strain[1, g] + strain[2, g]
        test = 0.0
        for i in range(len(rows)):
            value = sigma[U(i), p] + (twice * strain[U(i), g] + (lam * trace if i < 3 else 0.0))
            sigma[U(i), p] = value
            test += value * 0.0
        bad += test != 0
    return bad


@njit(**INLINE)
def _slip(q, eps_p, shear, peak, residual, softening):
    root = np.sqrt(3.0)
    cohesion = max(residual, peak + softening * eps_p)
    soft = (q - root * cohesion) / (3 * shear + root * softening)
    return max(0.0, min(soft, (q - root * residual) / (3 * shear)))


@njit(**OPTIONS)
def _von_mises(strain, first, sigma, eps_p, volume, constants, rows, p0, p1):
    """Closed-form return; leaves the energy that plastic flow takes in the first row of ``strain``."""
    bad = 0
    lam, shear, peak, residual, softening = constants
    for k in range(p0, p1):
        p, g = U(k), U(k - first)
        part = lam * (strain[0, g] + strain[1, g] + strain[2, g])
        s0 = sigma[0, p] + (2 * shear * strain[0, g] + part)
        s1 = sigma[1, p] + (2 * shear * strain[1, g] + part)
        s2 = sigma[2, p] + (2 * shear * strain[2, g] + part)
        s3 = sigma[3, p] + 2 * shear * strain[3, g]
        mean = (s0 + s1 + s2) / 3
        d0, d1, d2 = s0 - mean, s1 - mean, s2 - mean
        square = d0 * d0 + d1 * d1 + d2 * d2 + 2 * (s3 * s3)
        if len(rows) == 6:
            s4, s5 = sigma[4, p] + 2 * shear * strain[4, g], sigma[5, p] + 2 * shear * strain[5, g]
            square += 2 * (s4 * s4) + 2 * (s5 * s5)
        q = np.sqrt(1.5 * square)
        slip = _slip(q, eps_p[0, p], shear, peak, residual, softening)
        scale = 3 * shear * slip / (q if q > 0 else 1.0)
        sigma[0, p], sigma[1, p], sigma[2, p] = s0 - scale * d0, s1 - scale * d1, s2 - scale * d2
        sigma[3, p] = s3 - scale * s3
        if len(rows) == 6:
            sigma[4, p], sigma[5, p] = s4 - scale * s4, s5 - scale * s5
        after = eps_p[0, p] + slip
        eps_p[0, p] = after
        cohesion = max(residual, peak + softening * after)
        strain[0, g] = np.sqrt(3.0) * cohesion * slip * volume[p] if slip > 0 else 0.0
        bad += (square + mean) * 0.0 != 0
    return bad


@njit(**OPTIONS)
def _total(grad, count):
    a = b = c = d = 0.0
    row, last = grad[0], count // 4 * 4
    for p in range(0, last, 4):
        a += row[p]
        b += row[p + 1]
        c += row[p + 2]
        d += row[p + 3]
    for p in range(last, count):
        a += row[p]
    return (a + b) + (c + d)


@njit(parallel=True, **OPTIONS)
def elastic1(grad, sigma, volume, hoop, lam, twice, bad, rows):
    """Linear elasticity; ``bad (tiles, 2)`` counts points inside out and points not finite."""
    for tile in prange(len(bad)):
        p0, p1 = tile * TILE, min((tile + 1) * TILE, len(volume))
        bad[tile, 0] = _turn1(sigma, grad, 0, volume, hoop, p0, p1)
        bad[tile, 1] = _elastic(grad, 0, sigma, lam, twice, rows, p0, p1)


@njit(parallel=True, **OPTIONS)
def von_mises1(grad, sigma, eps_p, volume, hoop, constants, bad, work, rows):
    """Von Mises plasticity with linear softening; ``work (tiles,)`` takes the energy that plastic flow takes."""
    for tile in prange(len(bad)):
        p0, p1 = tile * TILE, min((tile + 1) * TILE, len(volume))
        bad[tile, 0] = _turn1(sigma, grad, 0, volume, hoop, p0, p1)
        bad[tile, 1] = _von_mises(grad, 0, sigma, eps_p, volume, constants, rows, p0, p1)
        work[tile] = _total(grad[:, p0:p1], p1 - p0)


@njit(parallel=True, **OPTIONS)
def elastic2(grad, sigma, volume, hoop, lam, twice, bad, rows):
    """Linear elasticity in two dimensions."""
    for tile in prange(len(bad)):
        p0, p1 = tile * TILE, min((tile + 1) * TILE, len(volume))
        bad[tile, 0] = _turn2(sigma, grad, 0, volume, hoop, p0, p1)
        bad[tile, 1] = _elastic(grad, 0, sigma, lam, twice, rows, p0, p1)


@njit(parallel=True, **OPTIONS)
def von_mises2(grad, sigma, eps_p, volume, hoop, constants, bad, work, rows):
    """Von Mises plasticity in two dimensions."""
    for tile in prange(len(bad)):
        p0, p1 = tile * TILE, min((tile + 1) * TILE, len(volume))
        bad[tile, 0] = _turn2(sigma, grad, 0, volume, hoop, p0, p1)
        bad[tile, 1] = _von_mises(grad, 0, sigma, eps_p, volume, constants, rows, p0, p1)
        work[tile] = _total(grad[:, p0:p1], p1 - p0)


@njit(parallel=True, **OPTIONS)
def elastic3(grad, sigma, volume, hoop, lam, twice, bad, rows):
    """Linear elasticity in three dimensions."""
    for tile in prange(len(bad)):
        p0, p1 = tile * TILE, min((tile + 1) * TILE, len(volume))
        bad[tile, 0] = _turn3(sigma, grad, 0, volume, hoop, p0, p1)
        bad[tile, 1] = _elastic(grad, 0, sigma, lam, twice, rows, p0, p1)


@njit(parallel=True, **OPTIONS)
def von_mises3(grad, sigma, eps_p, volume, hoop, constants, bad, work, rows):
    """Von Mises plasticity in three dimensions."""
    for tile in prange(len(bad)):
        p0, p1 = tile * TILE, min((tile + 1) * TILE, len(volume))
        bad[tile, 0] = _turn3(sigma, grad, 0, volume, hoop, p0, p1)
        bad[tile, 1] = _von_mises(grad, 0, sigma, eps_p, volume, constants, rows, p0, p1)
        work[tile] = _total(grad[:, p0:p1], p1 - p0)

"""Stress at the points: turning it with the spin of the step, then the law, branch-free over component rows.

``grad`` comes in with the rows of the displacement gradient, the point ``first`` in its first column.  Each function
handles one tile and writes to ``bad`` how many points turned inside out and how many have a stress that is not finite.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from .options import INLINE, SUMS

U = np.uint64


@njit(**INLINE)
def _with_hoop(ratio, hoop_stretch):
    """Volume ratio; negative for any inverted stretch, even an inverted pair."""
    return ratio * hoop_stretch if hoop_stretch > 0 else -abs(ratio * hoop_stretch)


@njit(**INLINE)
def _changed(volume, p, ratio):
    """Change a volume; one if what is left is none."""
    after = volume[p] * ratio
    volume[p] = after
    return np.int64(not 0 < after < np.inf)


@njit(**INLINE)
def _spin2(xx, xy, yx, yy, sxx, syy, sxy):
    """Stress turned by the step, by Hughes and Winget."""
    a = (xy - yx) / 4
    scale = 1 / (1 + a * a)
    c, s = (1 - a * a) * scale, 2 * a * scale
    cc, ss, cs = c * c, s * s, c * s
    return cc * sxx + 2 * cs * sxy + ss * syy, ss * sxx - 2 * cs * sxy + cc * syy, cs * (syy - sxx) + (cc - ss) * sxy


@njit(**INLINE)
def _rotation(a, b, c):
    """Cayley's rotation of the antisymmetric tensor with components xy = a, yz = b, xz = c."""
    scale = 2 / (1 + a * a + b * b + c * c)
    return (1 - scale * (a * a + c * c), scale * (a - b * c), scale * (c + a * b),
            scale * (-a - b * c), 1 - scale * (a * a + b * b), scale * (b - a * c),
            scale * (-c + a * b), scale * (-b - a * c), 1 - scale * (b * b + c * c))


@njit(**INLINE)
def _spin3(a, b, c, s0, s1, s2, s3, s4, s5):
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = _rotation(a / 4, b / 4, c / 4)
    a0, a1, a2 = r00 * s0 + r01 * s3 + r02 * s5, r00 * s3 + r01 * s1 + r02 * s4, r00 * s5 + r01 * s4 + r02 * s2
    b0, b1, b2 = r10 * s0 + r11 * s3 + r12 * s5, r10 * s3 + r11 * s1 + r12 * s4, r10 * s5 + r11 * s4 + r12 * s2
    c0, c1, c2 = r20 * s0 + r21 * s3 + r22 * s5, r20 * s3 + r21 * s1 + r22 * s4, r20 * s5 + r21 * s4 + r22 * s2
    return (a0 * r00 + a1 * r01 + a2 * r02, b0 * r10 + b1 * r11 + b2 * r12, c0 * r20 + c1 * r21 + c2 * r22,
            a0 * r10 + a1 * r11 + a2 * r12, b0 * r20 + b1 * r21 + b2 * r22, a0 * r20 + a1 * r21 + a2 * r22)


@njit(**INLINE)
def _ratio3(xx, xy, xz, yx, yy, yz, zx, zy, zz):
    return ((1 + xx) * ((1 + yy) * (1 + zz) - yz * zy) - xy * (yx * (1 + zz) - yz * zx)
            + xz * (yx * zy - (1 + yy) * zx))


@njit(**INLINE)
def turn1(sigma, grad, first, volume, hoop, bad, p0, p1):
    """Turn stress and change volumes; leaves the packed strain increment in ``grad``."""
    inverted = 0
    for q in range(p0, p1):
        p, g = U(q), U(q - first)
        ratio = 1 + grad[0, g]
        if len(hoop):
            ratio = _with_hoop(ratio, 1 + grad[1, g])
            grad[2, g], grad[1, g], grad[3, g] = grad[1, g], 0.0, 0.0
        inverted += _changed(volume, p, ratio)
    bad[0] = inverted


@njit(**INLINE)
def turn2(sigma, grad, first, volume, hoop, bad, p0, p1):
    """The same in two dimensions."""
    inverted = 0
    for q in range(p0, p1):
        p, g = U(q), U(q - first)
        xx, xy, yx, yy = grad[0, g], grad[1, g], grad[2, g], grad[3, g]
        sigma[0, p], sigma[1, p], sigma[3, p] = _spin2(xx, xy, yx, yy, sigma[0, p], sigma[1, p], sigma[3, p])
        ratio = (1 + xx) * (1 + yy) - xy * yx
        ratio = _with_hoop(ratio, 1 + grad[4, g]) if len(hoop) else ratio
        grad[1, g], grad[2, g], grad[3, g] = yy, grad[4, g] if len(hoop) else 0.0, (xy + yx) / 2
        inverted += _changed(volume, p, ratio)
    bad[0] = inverted


@njit(**INLINE)
def turn3(sigma, grad, first, volume, hoop, bad, p0, p1):
    """The same in three dimensions."""
    inverted = 0
    for q in range(p0, p1):
        p, g = U(q), U(q - first)
        xx, xy, xz = grad[0, g], grad[1, g], grad[2, g]
        yx, yy, yz = grad[3, g], grad[4, g], grad[5, g]
        zx, zy, zz = grad[6, g], grad[7, g], grad[8, g]
        (sigma[0, p], sigma[1, p], sigma[2, p], sigma[3, p], sigma[4, p],
         sigma[5, p]) = _spin3(xy - yx, yz - zy, xz - zx, sigma[0, p], sigma[1, p], sigma[2, p], sigma[3, p],
                               sigma[4, p], sigma[5, p])
        ratio = _ratio3(xx, xy, xz, yx, yy, yz, zx, zy, zz)
        grad[0, g], grad[1, g], grad[2, g] = xx, yy, zz
        grad[3, g], grad[4, g], grad[5, g] = (xy + yx) / 2, (yz + zy) / 2, (xz + zx) / 2
        inverted += _changed(volume, p, ratio)
    bad[0] = inverted


@njit(**INLINE)
def elastic1(sigma, grad, first, volume, hoop, bad, lam, twice, p0, p1):
    """Linear elasticity of the Jaumann rate in one dimension."""
    inverted = wrong = 0
    for q in range(p0, p1):
        p, g = U(q), U(q - first)
        slope = grad[0, g]
        ring = grad[1, g] if len(hoop) else 0.0
        ratio = _with_hoop(1 + slope, 1 + ring) if len(hoop) else 1 + slope
        part = lam * (slope + ring)
        after = sigma[0, p] + (twice * slope + part)
        sigma[0, p] = after
        if len(hoop):
            sigma[1, p] += part
            sigma[2, p] += twice * ring + part
            after += sigma[1, p] + sigma[2, p]
        wrong += np.int64(after * 0.0 != 0.0)
        inverted += _changed(volume, p, ratio)
    bad[0], bad[1] = inverted, wrong


@njit(**INLINE)
def elastic2(sigma, grad, first, volume, hoop, bad, lam, twice, p0, p1):
    """The same in two dimensions."""
    inverted = wrong = 0
    for q in range(p0, p1):
        p, g = U(q), U(q - first)
        xx, xy, yx, yy = grad[0, g], grad[1, g], grad[2, g], grad[3, g]
        ring = grad[4, g] if len(hoop) else 0.0
        sxx, syy, sxy = _spin2(xx, xy, yx, yy, sigma[0, p], sigma[1, p], sigma[3, p])
        ratio = (1 + xx) * (1 + yy) - xy * yx
        ratio = _with_hoop(ratio, 1 + ring) if len(hoop) else ratio
        part = lam * (xx + yy + ring)
        s0, s1 = sxx + (twice * xx + part), syy + (twice * yy + part)
        s2, s3 = sigma[2, p] + (twice * ring + part), sxy + twice * ((xy + yx) / 2)
        sigma[0, p], sigma[1, p], sigma[2, p], sigma[3, p] = s0, s1, s2, s3
        wrong += np.int64((s0 + s1 + s2 + s3) * 0.0 != 0.0)
        inverted += _changed(volume, p, ratio)
    bad[0], bad[1] = inverted, wrong


@njit(**INLINE)
def elastic3(sigma, grad, first, volume, hoop, bad, lam, twice, p0, p1):
    """The same in three dimensions."""
    inverted = wrong = 0
    for q in range(p0, p1):
        p, g = U(q), U(q - first)
        xx, xy, xz = grad[0, g], grad[1, g], grad[2, g]
        yx, yy, yz = grad[3, g], grad[4, g], grad[5, g]
        zx, zy, zz = grad[6, g], grad[7, g], grad[8, g]
        s0, s1, s2, s3, s4, s5 = _spin3(xy - yx, yz - zy, xz - zx, sigma[0, p], sigma[1, p], sigma[2, p], sigma[3, p],
                                        sigma[4, p], sigma[5, p])
        part = lam * (xx + yy + zz)
        s0, s1, s2 = s0 + (twice * xx + part), s1 + (twice * yy + part), s2 + (twice * zz + part)
        s3, s4 = s3 + twice * ((xy + yx) / 2), s4 + twice * ((yz + zy) / 2)
        s5 += twice * ((xz + zx) / 2)
        sigma[0, p], sigma[1, p], sigma[2, p], sigma[3, p], sigma[4, p], sigma[5, p] = s0, s1, s2, s3, s4, s5
        wrong += np.int64((s0 + s1 + s2 + s3 + s4 + s5) * 0.0 != 0.0)
        ratio = _ratio3(xx, xy, xz, yx, yy, yz, zx, zy, zz)
        inverted += _changed(volume, p, ratio)
    bad[0], bad[1] = inverted, wrong


@njit(**INLINE)
def _slip(q, cohesion, shear, residual, softening):
    root = np.sqrt(3.0)
    soft = (q - root * cohesion) / (3 * shear + root * softening)
    return max(0.0, min(soft, (q - root * residual) / (3 * shear)))


@njit(**INLINE)
def von_mises(strain, first, sigma, eps_p, volume, constants, bad, rows, p0, p1):
    """Closed-form return; leaves the energy that plastic flow takes in the first row of ``strain``."""
    lam, shear, peak, residual, softening = constants
    wrong = 0
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
        before = max(residual, peak + softening * eps_p[0, p])
        slip = _slip(q, before, shear, residual, softening)
        scale = 3 * shear * slip / (q if q > 0 else 1.0)
        sigma[0, p], sigma[1, p], sigma[2, p] = s0 - scale * d0, s1 - scale * d1, s2 - scale * d2
        sigma[3, p] = s3 - scale * s3
        if len(rows) == 6:
            sigma[4, p], sigma[5, p] = s4 - scale * s4, s5 - scale * s5
        after = eps_p[0, p] + slip
        eps_p[0, p] = after
        cohesion = (before + max(residual, peak + softening * after)) / 2
        strain[0, g] = np.sqrt(3.0) * cohesion * slip * volume[p] if slip > 0 else 0.0
        wrong += np.int64((square + mean + after) * 0.0 != 0.0)
    bad[1] = wrong


@njit(**SUMS)
def total(row, p0, p1):
    """Sum of a tile."""
    sum_ = 0.0
    for q in range(U(p0), U(p1)):
        sum_ += row[q]
    return sum_

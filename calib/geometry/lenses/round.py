"""Lenses that are round about an axis: those of CAHV, CAHVOR and CAHVORE, and cv2.fisheye's.

Letters as in JPL's camera-model library, z of the lens frame along O: chi is the undistorted slope,
chi' = chi (1 + r0 + r1 chi^2 + r2 chi^4 + ...) the distorted one, theta the ray's angle to O, lambda and zeta
the point's distance from O and along it. CAHV and CAHVOR have chi = lambda/zeta = tan theta, CAHVORE

    chi = tan(l theta)/l | theta | sin(l theta)/l        for linearity l above, at, below 0

and an entrance point that moves along O with the ray's angle (`Entrance`):

    s(theta) = (theta/sin theta - 1) (e0 + e1 theta^2 + e2 theta^4)     entrance point at C + s O
    f(theta) = zeta sin theta - lambda cos theta - s sin theta = 0      the ray through the point

It makes rays cross: along the ray at theta, points nearer than s'(theta) sin(theta) lie before the crossing
(f' < 0 there). The ray through a point is the theta with f(theta) = 0 on the side where f grows, and only if
no second ray of the image passes through the point.

Kannala and Brandt's lens, as cv2.fisheye and Kalibr (equidistant) have it, is that of linearity 0 with k1 to
k4 for r1 to r4, and no entrance point that moves. cv2.fisheye begins with a/w and b/w, so its points are
those with w > 0; here theta may go on.

The lens ends where chi' stops growing: beyond, a point would appear a second time, inside the image.
Sources: Gennery 2001, 2006; JPL's ``cmod_cahv*.c``; Kannala and Brandt, IEEE PAMI 28 (2006) 1335.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import asin, atan, degrees, inf, pi, sin, tan

import numpy as np

from calib.geometry.lenses import SETTLED, TINY, Bent, Unbent, first_root, polynomial
from calib.geometry.rigid import FloatArray

NEAREST_M = 1e-9
"""A point this near the entrance point has no direction from it."""


_TERMS = 9
"""Terms of the polynomial that an inverse begins with."""

_SETTLED_RAD = 1e-9
"""Newton stops after a step below this: the derivative is good to that part of itself."""


@dataclass(frozen=True)
class Entrance:
    """The entrance point of one lens, e0 to e2.

    ``image_rad`` and ``limit_rad`` are the largest angle inside the image, and the first that the lens does
    not reach.
    """

    e: tuple[float, float, float]
    image_rad: float
    limit_rad: float

    @cached_property
    def near_m(self) -> float:
        """How far from C neighbouring rays of the image cross, with 2 % to spare: farther none do."""
        e0, e1, e2 = self.e
        theta = np.linspace(0.0, min(self.image_rad, 0.999 * pi), 513)[1:]
        y = theta * theta
        along, rate = e0 + y * (e1 + y * e2), theta * (2.0 * e1 + 4.0 * y * e2)
        shift = (theta / np.sin(theta) - 1.0) * along
        # s'(theta) sin(theta): the distance along the ray, from its entrance point, of the crossing
        crossing = along * (1.0 - theta / np.tan(theta)) + (theta - np.sin(theta)) * rate
        ends = np.hypot(shift + crossing * np.cos(theta), crossing * np.sin(theta))
        far = np.maximum(np.abs(shift), ends)[crossing > 0.0]
        return 1.02 * float(far.max(initial=0.0))

    def angle(
        self, lam: FloatArray, w: FloatArray, derivatives: bool
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, np.ndarray]:
        """Return theta of the ray through points, its sine and cosine, f'(theta), and where that is right.

        Newton on the turn from the direction seen from C: with g = s sin(theta) the condition reads
        f = rho sin(turn) - g = 0.
        """
        per_rho = 1.0 / np.sqrt(lam * lam + w * w)
        start, sine, cosine = np.arctan2(lam, w), lam * per_rho, w * per_rho
        lag, lag_rate = self._lag_over_range(start, sine, cosine, per_rho)
        turn = lag / (1.0 - lag_rate)
        for _ in range(8):
            sine_turn, cosine_turn = np.sin(turn), np.cos(turn)
            sine = (lam * cosine_turn + w * sine_turn) * per_rho
            cosine = (w * cosine_turn - lam * sine_turn) * per_rho
            lag, lag_rate = self._lag_over_range(start + turn, sine, cosine, per_rho)
            slope = cosine_turn - lag_rate
            step = (sine_turn - lag) / slope
            turn -= step
            if np.abs(step, out=step).max() < _SETTLED_RAD:
                break
        theta = start + turn
        settled = (step < _SETTLED_RAD) & (slope > 0.0) & (lam > NEAREST_M * sine)

        # With f(image_rad) > 0 the ray is inside the image; what Newton did not find there, or may have
        # found twice because rays cross so near the lens, is searched for.
        edge, (e0, e1, e2) = self.image_rad, self.e
        edge_lag = (edge - np.sin(edge)) * (e0 + edge**2 * (e1 + edge**2 * e2))
        unsure = w * np.sin(edge) - lam * np.cos(edge) > edge_lag
        unsure &= ~(settled & (theta > 0.0) & (theta <= edge))
        if self.near_m > 0.0:
            unsure |= per_rho * self.near_m >= 1.0
        if unsure.any():
            found = self.search(lam[unsure], w[unsure])
            theta[unsure] = found
            settled[unsure] = found > 0.0  # not a number where none was found
            if derivatives:
                sine, cosine = np.sin(theta), np.cos(theta)
                slope = np.cos(theta - start) - self._lag_over_range(theta, sine, cosine, per_rho)[1]
        return theta, sine, cosine, slope / per_rho, settled

    def _lag_over_range(
        self, theta: FloatArray, sine: FloatArray, cosine: FloatArray, per_rho: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """g/rho and g'/rho, with g = (theta - sin theta) (e0 + e1 theta^2 + e2 theta^4)."""
        e0, e1, e2 = self.e
        y = theta * theta
        e = (e0 + y * (e1 + y * e2)) * per_rho
        lag = theta - sine
        rate = (2.0 * e1 + y * (4.0 * e2)) * theta * lag * per_rho
        rate += e * (1.0 - cosine)
        return e * lag, rate

    def search(self, lam: FloatArray, w: FloatArray) -> FloatArray:
        """Return the smallest theta of a ray through points (n,), found by its change of sign.

        Not-a-number where there is none, and where two rays of the image pass through the point.
        """
        e0, e1, e2 = self.e

        def miss(theta: FloatArray, lam: FloatArray, w: FloatArray) -> FloatArray:
            y, sine = theta * theta, np.sin(theta)
            return np.asarray(w * sine - lam * np.cos(theta) - (theta - sine) * (e0 + y * (e1 + y * e2)))

        # 257: angles at which the slow search for a ray checks for a change of sign.
        nodes = np.linspace(0.0, self.limit_rad, 257)
        positive = miss(nodes, lam[:, None], w[:, None]) > 0.0
        rising = ~positive[:, :-1] & positive[:, 1:]
        cell = rising.argmax(axis=1)
        low, high = nodes[cell], nodes[cell + 1]
        for _ in range(50):
            middle = 0.5 * (low + high)
            beyond = miss(middle, lam, w) > 0.0
            low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
        theta = 0.5 * (low + high)
        y, sine, cosine = theta * theta, np.sin(theta), np.cos(theta)
        slope = w * cosine + lam * sine - (1.0 - cosine) * (e0 + y * (e1 + y * e2))
        slope -= (theta - sine) * theta * (2.0 * e1 + (4.0 * e2) * y)
        theta -= np.clip(miss(theta, lam, w) / slope, -1e-12, 1e-12)  # the last digits of a small angle
        changes = (positive[:, :-1] != positive[:, 1:]) & (nodes[:-1] < self.image_rad)
        twice = np.count_nonzero(changes, axis=1) > 1
        lost = twice | ~rising.any(axis=1) | ~(slope > 0.0) | ~(lam > NEAREST_M * np.sin(theta))
        return np.where(lost, np.nan, theta)


@dataclass(frozen=True, eq=False)
class RoundLens:
    """One lens.

    Attributes
    ----------
    r, e
        r0, r1, r2, ...: 1 + r0 is above zero. e0, e1, e2 of the entrance point; used only if ``curved``.
    curved
        True for CAHVORE and the fisheye: the slope follows the angle by ``linearity``.
    linearity
        1 perspective, 0 fisheye.
    image_slope
        The largest distorted slope chi' inside the image; infinite if part of the image has no ray.
    """

    r: tuple[float, ...]
    e: tuple[float, float, float] = (0.0, 0.0, 0.0)
    curved: bool = False
    linearity: float = 1.0
    image_slope: float = inf

    @property
    def moving(self) -> bool:
        """Whether the entrance point moves at all."""
        return self.curved and any(self.e)

    @cached_property
    def _values(self) -> tuple[float, ...]:
        """Coefficients of chi' / chi in chi^2."""
        return (1.0 + self.r[0], *self.r[1:])

    @cached_property
    def _growth(self) -> tuple[float, ...]:
        """Coefficients of d chi' / d chi in chi^2."""
        return tuple((2 * power + 1) * value for power, value in enumerate(self._values))

    @cached_property
    def chi_limit(self) -> float:
        """The first chi that the lens does not reach."""
        largest = max(map(abs, self._values))
        fold = float(
            np.sqrt(first_root(tuple((2 * i + 1) * (c / largest) for i, c in enumerate(self._values))))
        )
        return min(fold, self._chi_of(self._theta_of(fold))) if self.curved else fold

    @cached_property
    def limit_rad(self) -> float:
        """The first angle that the lens does not reach."""
        return self._theta_of(self.chi_limit)

    @property
    def limit_reason(self) -> str:
        """Where the lens ends, as the end of a sentence; empty if that is where its family ends."""
        end = self.limit_rad
        if self.chi_limit == inf or end >= self._theta_of(inf):
            return ""
        return f"the lens folds at {degrees(end):.1f} degrees from its axis"

    @cached_property
    def _distorted_limit(self) -> float:
        """The first chi' that no ray lands on."""
        chi = self.chi_limit
        return inf if chi == inf else chi * float(polynomial(self._values, np.array(chi * chi)))

    @cached_property
    def entrance(self) -> Entrance:
        """The entrance point that moves."""
        with np.errstate(all="ignore"):
            limit_rad = self.limit_rad
            image_rad = limit_rad
            if self.image_slope < self._distorted_limit:
                (k,) = self._shrink(np.array([self.image_slope**2]))
                image_rad = self._theta_of(k * self.image_slope)
            return Entrance(self.e, image_rad, limit_rad)

    def _theta_of(self, chi: float) -> float:
        """Angle of slope ``chi``, at most what the linearity and half a turn allow."""
        line = self.linearity if self.curved else 1.0
        if line > 0.0:
            return min(pi, atan(line * chi) / line)
        return min(pi, asin(min(1.0, -line * chi)) / -line) if line < 0.0 else min(pi, chi)

    def _chi_of(self, theta_rad: float) -> float:
        """Slope of an angle within the reach."""
        line = self.linearity
        if line > 0.0:
            return inf if line * theta_rad >= pi / 2 else tan(line * theta_rad) / line
        return sin(line * theta_rad) / line if line < 0.0 else theta_rad

    def _slope(
        self, lam: FloatArray, w: FloatArray, derivatives: bool
    ) -> tuple[FloatArray, np.ndarray, FloatArray, FloatArray]:
        """chi of points, where the lens reaches them, and d chi / d lambda, d chi / d zeta if wanted."""
        if not self.curved:
            per_w = 1.0 / w
            chi = lam * per_w
            return chi, (w > 0.0) & (chi < self.chi_limit), per_w, -chi * per_w
        if self.moving:
            theta, sine, cosine, rate, valid = self.entrance.angle(lam, w, derivatives)
        else:
            theta = np.arctan2(lam, w)
            rho2 = lam * lam + w * w
            valid = (rho2 > NEAREST_M * NEAREST_M) & (rho2 < inf)
            sine, cosine, rate = lam, w, rho2  # all three times the range, which cancels
        chi = self._chi_of_angles(theta)
        valid &= (theta > 0.0) & (theta < self.limit_rad) & (chi < self.chi_limit)
        if not derivatives:
            return chi, valid, chi, chi
        per = self._chi_rate(theta, chi) / rate
        return chi, valid, per * cosine, -per * sine

    def _chi_of_angles(self, theta: FloatArray) -> FloatArray:
        line = self.linearity
        if line == 0.0:
            return theta
        return np.asarray((np.tan if line > 0.0 else np.sin)(line * theta) / line)

    def _chi_rate(self, theta: FloatArray, chi: FloatArray) -> FloatArray | float:
        """d chi / d theta."""
        line = self.linearity
        if line == 0.0:
            return 1.0
        return np.asarray(1.0 + (line * chi) ** 2 if line > 0.0 else np.cos(line * theta))

    def bend(self, local_m: FloatArray, derivatives: bool = False) -> Bent:
        """Return where points (3, n), rows a, b, w of the lens frame, are seen."""
        a, b, w = local_m
        lam = np.maximum(np.sqrt(a * a + b * b), TINY)
        chi, valid, by_lam, by_w = self._slope(lam, w, derivatives)
        chi2 = chi * chi
        m = polynomial(self._values, chi2)
        m *= chi
        m /= lam
        slopes = local_m[:2] * m
        if not derivatives:
            return Bent(slopes, valid)
        growth = polynomial(self._growth, chi2)
        along = local_m[:2] / lam
        rates = np.empty((2, 3, len(w)))
        np.multiply(along * (growth * by_lam - m), along[:, None], out=rates[:, :2])
        rates[0, 0] += m
        rates[1, 1] += m
        np.multiply(along, growth * by_w, out=rates[:, 2])
        return Bent(slopes, valid, rates)

    def coefficient_rates(self, local_m: FloatArray) -> FloatArray:
        """Return d slope / d (r1, r2, ..., and e0, e1, e2 of a CAHVORE) (2, k, n) of points (3, n)."""
        a, b, w = local_m
        lam = np.maximum(np.sqrt(a * a + b * b), TINY)
        with_e = self.curved and len(self.r) == 3  # the fisheye has more coefficients and no e
        if with_e:
            theta, sine, _, rate, _ = self.entrance.angle(lam, w, True)
            chi = self._chi_of_angles(theta)
        else:
            chi = self._slope(lam, w, False)[0]
        chi2 = chi * chi
        rates = [chi * chi2]
        for _ in self.r[2:]:
            rates.append(rates[-1] * chi2)
        if with_e:
            y = theta * theta
            per_e = (theta - sine) / rate * self._chi_rate(theta, chi) * polynomial(self._growth, chi2)
            rates += [per_e, per_e * y, per_e * y * y]
        return np.asarray(local_m[:2, None] / lam * np.array(rates))

    def unbend(self, slopes: FloatArray, derivatives: bool = False) -> Unbent:
        """Return the rays that land on slopes (2, n)."""
        squares = slopes * slopes
        t2 = squares[0] + squares[1]
        limit2 = self._distorted_limit * self._distorted_limit
        valid = t2 < limit2 * (1.0 + 8e-15)
        if not valid.all():
            t2 = np.where(valid, t2, 0.0)
        t = np.maximum(np.sqrt(t2), TINY)
        chi = self._shrink(t2)
        chi *= t
        valid &= chi < self.chi_limit
        line = self.linearity
        if not self.curved:
            cosine = 1.0 / np.sqrt(1.0 + chi * chi)
            sine = chi * cosine
        else:
            theta = chi if line == 0.0 else (np.arctan if line > 0.0 else np.arcsin)(line * chi) / line
            valid &= theta < self.limit_rad
            sine, cosine = np.sin(theta), np.cos(theta)
        p = sine / t
        directions = np.empty((3, len(t)))
        np.multiply(slopes, p, out=directions[:2])
        directions[2] = cosine
        shift_m = shift_rates = None
        if self.moving:
            e0, e1, e2 = self.e
            y = theta * theta
            e, stretch = e0 + y * (e1 + y * e2), theta / sine - 1.0
            shift_m = stretch * e
        if not derivatives:
            return Unbent(directions, valid, None, shift_m)
        turn = 1.0 / polynomial(self._growth, chi * chi)  # d theta / d chi'
        turn *= cosine * cosine if not self.curved else 1.0 / self._chi_rate(theta, chi)
        along = slopes / t
        rates = np.empty((3, 2, len(t)))
        np.multiply(along * (cosine * turn - p), along[:, None], out=rates[:2])
        rates[0, 0] += p
        rates[1, 1] += p
        np.multiply(along, -sine * turn, out=rates[2])
        if self.moving:
            y2 = theta * theta
            # (theta/sin theta)' by its series where the closed form would cancel
            stretch_rate = np.where(
                theta < 0.1,
                theta * (1 / 3 + y2 * (7 / 90 + y2 * (31 / 2520 + y2 * (127 / 75600 + y2 * (73 / 342144))))),
                (sine - theta * cosine) / (sine * sine),
            )
            per_turn = stretch_rate * e + stretch * theta * (2.0 * e1 + 4.0 * e2 * y2)
            shift_rates = per_turn * turn * along
        return Unbent(directions, valid, rates, shift_m, shift_rates)

    def _shrink(self, t2: FloatArray) -> FloatArray:
        """chi / chi' of squared distorted slopes chi'^2 within the reach: Newton, near the fold halving."""
        first, *others = self._values
        if not any(others):
            return np.full_like(t2, 1.0 / first)
        k = polynomial(self._start, t2) if len(t2) > _TERMS else 1.0 / polynomial(self._values, t2)
        for _ in range(10):
            chi2 = k * k
            chi2 *= t2
            step = polynomial(self._values, chi2)
            step *= k
            step -= 1.0
            step /= polynomial(self._growth, chi2)
            k -= step
            if np.abs(step, out=step).max(initial=0.0) < SETTLED:
                break
        limit2 = self.chi_limit * self.chi_limit
        found = (step < SETTLED) & (k > 0.0) & (k * k * t2 < limit2)
        if not found.all():
            k[~found] = self._halved(np.sqrt(t2[~found]))
        return k

    @cached_property
    def _start(self) -> tuple[float, ...]:
        """Coefficients of about chi / chi' in chi'^2 over the image, which an inverse of many begins with."""
        farthest = min(self.image_slope, 0.999 * self._distorted_limit)
        if farthest == inf:
            return (1.0, 0.0)
        nodes = farthest**2 * (0.5 - 0.5 * np.cos(np.pi * (np.arange(_TERMS) + 0.5) / _TERMS))
        fit = np.polynomial.Polynomial.fit(nodes, self._shrink(nodes), _TERMS - 1)
        return tuple(fit.convert().coef.tolist())

    def _halved(self, t: FloatArray) -> FloatArray:
        """chi / chi' of slopes chi' close to the fold, or where a fold leads Newton astray."""

        def beyond(chi: FloatArray) -> np.ndarray:
            return np.asarray(chi * polynomial(self._values, chi * chi) > t)

        low, high = np.zeros_like(t), np.full_like(t, self.chi_limit if self.chi_limit < inf else 1.0)
        while self.chi_limit == inf and not (far := beyond(high)).all():
            high = np.where(far, high, 2.0 * high)
        for _ in range(70):
            middle = 0.5 * (low + high)
            far = beyond(middle)
            low, high = np.where(far, low, middle), np.where(far, middle, high)
        # 1.0 - 1e-15: this part of the largest slope is reached for sure; above it rounding decides.
        return np.asarray(np.minimum(low, (1.0 - 1e-15) * self.chi_limit) / t)

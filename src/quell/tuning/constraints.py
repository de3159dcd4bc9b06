"""Bounds of a tuned loop.

With ``S = 1/(1 + L)``, ``T = 1 − S`` and the controller C_y from −y to u, the bounds are those of
Åström & Hägglund (*Advanced PID Control*, ISA 2006, section 4.6): ``M_s = max |S|``, ``M_t = max
|T|``, ``M_ks = max |C_y S|``, over the frequencies up to half the sampling rate.
"""

from __future__ import annotations

from dataclasses import dataclass

from quell import checks


@dataclass(frozen=True, kw_only=True)
class Constraints:
    """Bounds for a tuned loop; None and omitted bounds do not hold.

    Parameters
    ----------
    m_s
        largest ``|S|``; 1.6 leaves a modulus margin of 0.625, a gain margin of at least 2.7 and a
        phase margin of at least 36°.
    m_t
        largest ``|T|``.
    m_ks
        largest gain from a sinusoid in y to u [u-unit/y-unit]; it bounds what noise does to u.
    u_std
        largest standard deviation of u [u-unit] that white noise of ``noise_std`` in y causes.
    noise_std
        standard deviation of the noise of y in each sample [y-unit]; goes with ``u_std``.
    delay_margin
        least additional dead time at which the loop becomes unstable [s].
    u_max
        largest ``|u|`` in the responses of the objective's scenario [u-unit].
    rate_max
        largest rate of u in them [u-unit/s].
    noise_over_pi
        without ``m_ks`` and ``u_std``, M_ks is bounded by this multiple of that of the optimal PI
        controller under the other constraints; None for no bound. Without one, an optimum with a
        derivative has the fastest filter that ``omega_o_dt`` allows.
    omega_o_dt
        largest ``|p| dt`` of the poles of an observer or of a filter of the measurement; beyond
        0.5 sampling costs margin (docs/design).

    Raises
    ------
    ValueError
        for a bound that is not positive, M_s or M_t that no loop has, or ``u_std`` without
        ``noise_std``.
    """

    m_s: float | None = 1.6
    m_t: float | None = 1.6
    m_ks: float | None = None
    u_std: float | None = None
    noise_std: float | None = None
    delay_margin: float | None = None
    u_max: float | None = None
    rate_max: float | None = None
    noise_over_pi: float | None = 10.0
    omega_o_dt: float = 0.5

    def __post_init__(self) -> None:
        for name in ("m_s", "m_t", "m_ks", "u_std", "noise_std", "delay_margin", "u_max"):
            checks.optional(checks.positive, name, getattr(self, name))
        for name in ("rate_max", "noise_over_pi"):
            checks.optional(checks.positive, name, getattr(self, name))
        checks.positive("omega_o_dt", self.omega_o_dt)
        for name in ("m_s", "m_t"):
            value = getattr(self, name)
            if value is not None and value <= 1.0:
                raise ValueError(
                    f"{name} = {value!r}: must be above 1; |S| exceeds 1 at some frequency "
                    "in every loop, and |T| is 1 at low ones (1.4 is cautious, 2 is bold)"
                )
        if self.u_std is not None and self.noise_std is None:
            raise ValueError(
                f"u_std = {self.u_std!r}: needs noise_std, the noise of y that causes it"
            )
        if self.m_s is None and self.m_t is None:
            raise ValueError("m_s = None, m_t = None: one of them must bound the loop")

    def __str__(self) -> str:
        """Return the bounds that hold, as text."""
        parts = [
            ("M_s ≤ {:g}", self.m_s),
            ("M_t ≤ {:g}", self.m_t),
            ("M_ks ≤ {:g}", self.m_ks),
            ("std(u) ≤ {:g}" + f" for noise of {self.noise_std}", self.u_std),
            ("delay margin ≥ {:g} s", self.delay_margin),
            ("|u| ≤ {:g}", self.u_max),
            ("|u'| ≤ {:g}/s", self.rate_max),
            ("|p| dt ≤ {:g} for poles of observers and filters", self.omega_o_dt),
        ]
        return ", ".join(text.format(value) for text, value in parts if value is not None)

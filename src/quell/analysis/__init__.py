"""Analysis of loops: poles, margins, sensitivity functions, noise, frozen learners, plots.

May import ``simulation``, ``records``, ``controllers`` and what they import.
"""

from quell.analysis.advice import advise
from quell.analysis.certificate import Certificate, observer_error
from quell.analysis.coupled import CoupledCertificate, certify_coupled
from quell.analysis.coupling import Coupling, coupling, relative_gains
from quell.analysis.disk import DiskMargin
from quell.analysis.feedback import (
    BoundedObserver,
    analyse_feedback,
    law_of_feedback,
    observer_within,
)
from quell.analysis.linearise import Adapting, Frozen, adapting, frozen, linear_law
from quell.analysis.loop import LoopAnalysis
from quell.analysis.machine import (
    LoopsAtPoints,
    OnlineCertificate,
    analyse,
    analyse_points,
    certify,
    certify_online,
)
from quell.analysis.margins import Margins
from quell.analysis.matrices import MatrixLaw, axes_law
from quell.analysis.multivariable import MultivariableLoop, Peak, Pole
from quell.analysis.plots import (
    loops_over_omega_o,
    loops_over_time,
    plot_bode,
    plot_gang_of_four,
    plot_margins_against_omega_o,
    plot_margins_over_time,
    plot_nyquist,
    plot_root_locus,
)
from quell.controllers.adrc import Finding
from quell.lazy import imported_on_use, public_names
from quell.lti.zeros import (
    Existence,
    InvariantZeros,
    invariant_zeros,
    observer_exists,
    unobservable_modes,
)

__all__ = [
    "Adapting", "BoundedObserver", "Certificate", "CoupledCertificate", "Coupling", "DiskMargin",
    "Existence", "Finding", "Frozen", "InvariantZeros", "LoopAnalysis", "LoopsAtPoints", "Margins",
    "MatrixLaw", "MultivariableLoop", "OnlineCertificate", "Peak", "Pole", "adapting", "advise",
    "analyse", "analyse_feedback", "analyse_points", "axes_law", "certify", "certify_coupled",
    "certify_online", "coupling", "frozen", "invariant_zeros", "law_of_feedback", "linear_law",
    "loops_over_omega_o", "loops_over_time", "observer_error", "observer_exists", "observer_within",
    "plot_bode", "plot_gang_of_four", "plot_margins_against_omega_o", "plot_margins_over_time",
    "plot_nyquist", "plot_root_locus", "relative_gains", "unobservable_modes"
]  # fmt: skip

# Names of the last release.
__getattr__ = imported_on_use(
    __name__, {}, (), {"analyse_axes": "analyse", "certify_axes": "certify"}
)

__dir__ = public_names(__name__)

"""Prove an exported controller with a learner and a guard: ``proof_with_learner.py FOLDER``.

The other rows of ``benchmarks/proofs.py`` take hours.
"""

import sys

import quell as ql

observer = ql.ESO.model_free(order=2, b0=1.5, omega_o=12.0, dt=0.01)
learner = ql.learners.Kalman()
controller = ql.ADRC(observer, 1.5, learner=learner, guard=ql.Guard(), u_min=-2.0, u_max=3.0)
proof = ql.export.c(controller, sys.argv[1], proof=True).proof
print(proof.text)
assert proof.proved

"""A proof for an exported controller: what its C code can never do, whatever it is given.

May import everything in ``export`` but ``fmi``; ``library`` imports it. The proof is by abstract
interpretation: the plug-in Eva of Frama-C follows sets that contain all values which the variables
can have, through all paths, until they grow no more. What holds in these sets holds in every run.

* ``files.py`` writes a program that calls all functions in any order with any numbers, a contract
  for them in ACSL, and a script.
* ``frama_c.py`` runs Frama-C and reads what it has proved.
* ``structure.py`` reads from the code that it has no recursion, and counts the passes of its loops.
* ``report.py`` says the result in words.
"""

from quell.export.proof.files import proof_files
from quell.export.proof.frama_c import Alarm
from quell.export.proof.report import Proof, prove

__all__ = ["Alarm", "Proof", "proof_files", "prove"]

"""Optuna's study behind a search: its sampler and pruner, and its trials in a journal file.

The file is Optuna's own format (``JournalFileBackend``), one JSON object in each line, so that
its other tools read it. A search that was interrupted continues from it.
"""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from quell import checks
from quell.optional import import_extra

SAMPLERS = ("cma", "tpe", "nsga2", "qmc", "random")
PRUNERS = ("median", "halving", "none")
_ABOUT = "quell: problem"  # attribute of the study: what is searched
REASON = "quell: reason"  # and why its values were rejected, if they were
VIOLATION = "quell: violation"  # attribute of a trial: by how much it violates constraints


def optuna() -> Any:
    """Return Optuna's module, silent about each trial; ``ImportError`` names the extra."""
    module = import_extra("optuna", "tuning", "tuning by simulation")
    module.logging.set_verbosity(module.logging.ERROR)
    return module


def open_study(
    storage: str | os.PathLike[str] | None,
    name: str,
    objectives: int,
    about: Mapping[str, Any],
    pruner: Any,
) -> Any:
    """Return a new study, or the one of this name in the journal file ``storage``.

    Raises ``ValueError`` for a file that is no journal, or the journal of another problem.
    """
    module = optuna()
    chosen, backend = _pruner(module, pruner), None
    mine = json.loads(json.dumps(about))
    if storage is not None:
        backend = _journal(module, Path(storage))
        # create_study would write to the file of another search, too.
        if name in {each.study_name for each in backend.get_all_studies()}:
            study = module.load_study(storage=backend, study_name=name, pruner=chosen)
            stored = study.user_attrs.get(_ABOUT, {})
            if stored != mine:
                parts = sorted(key for key in mine if stored.get(key) != mine[key])
                raise ValueError(
                    f"storage = {os.fspath(storage)!r} holds another search, with other "
                    f"{', '.join(parts)}: give another file"
                )
            return study
    study = module.create_study(
        storage=backend, study_name=name, directions=["minimize"] * objectives, pruner=chosen
    )
    study.set_user_attr(_ABOUT, mine)
    return study


def sampler_for(sampler: Any, seed: int, trial: int, fixed: Mapping[str, float] | None) -> Any:
    """Return the sampler of the trial number ``trial``, with ``fixed`` values if there are any.

    A sampler by name is made anew for each trial, seeded by ``seed`` and the number. So a search
    that continues suggests what it would have suggested without the interruption.
    """
    samplers = optuna().samplers
    made = sampler
    if isinstance(sampler, str):
        name = checks.one_of("sampler", sampler, SAMPLERS)
        options: dict[str, Any] = {"seed": seed_of(seed, trial)}
        if name in ("random", "cma"):  # the values of "cma" are ``fixed``
            made = samplers.RandomSampler(**options)
        elif name == "qmc":
            made = _quietly(samplers.QMCSampler, scramble=True, seed=seed)
        elif name == "nsga2":
            made = _quietly(samplers.NSGAIISampler, constraints_func=_constraints, **options)
        else:
            options |= {"multivariate": True, "constraints_func": _constraints}
            made = _quietly(samplers.TPESampler, **options)
    if fixed is None:
        return made
    return _quietly(samplers.PartialFixedSampler, fixed_params=dict(fixed), base_sampler=made)


def seed_of(seed: int, trial: int) -> int:
    """Return the seed of a trial; those of searches with other seeds differ."""
    # NumPy's generators take 32 bits, and make independent streams of consecutive seeds.
    return (seed * 1_000_003 + trial) % 2**32


def begun_trial(study: Any, number: int) -> Any:
    """Return the unfinished trial of an interrupted search, with the values that it has."""
    known = study.get_trials(deepcopy=False)[number]
    return optuna().trial.Trial(study, known._trial_id)


def was_given_up(trial: Any, value: float, rung: int) -> bool:
    """Report the value on the samples so far; return whether the pruner gives the trial up."""
    with warnings.catch_warnings():
        # An interrupted search has reported the same value before.
        warnings.simplefilter("ignore")
        trial.report(value, rung)
    return bool(trial.should_prune())


def tell(study: Any, trial: Any, values: Sequence[float] | None) -> None:
    """Pass the values of a trial to the study; None for one that was given up."""
    if values is None:
        study.tell(trial, state=optuna().trial.TrialState.PRUNED)
    else:
        study.tell(trial, list(values))


def _constraints(trial: Any) -> Sequence[float]:
    return [float(trial.user_attrs.get(VIOLATION, 0.0))]


def _quietly(make: Any, **options: Any) -> Any:
    with warnings.catch_warnings():
        # Optuna warns that these options are experimental.
        warnings.simplefilter("ignore")
        return make(**options)


def _pruner(module: Any, pruner: Any) -> Any:
    if not isinstance(pruner, str):
        return pruner
    checks.one_of("pruner", pruner, PRUNERS)
    if pruner == "median":
        # With fewer finished trials a median says little: Optuna's own default is 5.
        return module.pruners.MedianPruner(n_startup_trials=10)
    if pruner == "halving":
        return module.pruners.SuccessiveHalvingPruner()
    return module.pruners.NopPruner()


def _journal(module: Any, path: Path) -> Any:
    """Return the storage of a journal file; an incomplete last line, of a kill, is cut off."""
    if path.exists():
        _repair(path)
    elif not path.parent.is_dir():
        raise ValueError(f"storage = {os.fspath(path)!r}: the folder does not exist")
    journal = module.storages.journal
    try:
        return module.storages.JournalStorage(journal.JournalFileBackend(os.fspath(path)))
    except (ValueError, KeyError, TypeError, AssertionError) as error:
        raise ValueError(
            f"storage = {os.fspath(path)!r}: must be a journal file of Optuna ({error})"
        ) from None


def _repair(path: Path) -> None:
    """Cut off an incomplete last line; raise a ``ValueError`` if the others are no journal."""
    with path.open("r+b") as file:
        content = file.read()
        end = content.rfind(b"\n") + 1
        if content and not (end and all(map(_is_operation, content[:end].splitlines()))):
            raise ValueError(f"storage = {os.fspath(path)!r}: must be a journal file of Optuna")
        file.truncate(end)


def _is_operation(line: bytes) -> bool:
    try:
        return {"op_code", "worker_id"} <= json.loads(line).keys()
    except (ValueError, AttributeError):
        return False

"""PyTorch modules as learners."""

from __future__ import annotations

from typing import Any, Unpack

from quell import checks
from quell.learners.adapters.python import Options, PythonModel
from quell.optional import import_extra
from quell.types import Matrix, Vector


class TorchModel(PythonModel):
    """A learner whose model is a PyTorch module.

    It is trained by gradient steps on the mean squared error of each batch.

    Parameters
    ----------
    module
        takes a tensor (m, p) and returns one of shape (m, 1) or (m,), on the CPU.
    optimizer
        an optimiser of the module's parameters, or a function that makes one from parameters, for
        example ``functools.partial(torch.optim.SGD, lr=0.05)``; SGD with a learning rate of 0.1 by
        default. Consecutive pairs are similar, and an optimiser that takes long steps on small
        gradients (Adam at its usual rates) unlearns the rest.
    steps
        gradient steps on each batch.
    **options
        ``features``, ``period``, ``budget``, ``frequency``, ``scale``: see ``PythonModel``.

    Raises
    ------
    ImportError
        if PyTorch is missing.
    ValueError
        for an object that is no module or no optimiser, and as ``PythonModel``.
    """

    def __init__(
        self, module: Any, optimizer: Any = None, *, steps: int = 1, **options: Unpack[Options]
    ) -> None:
        torch = import_extra("torch", "torch", "a PyTorch learner")
        if not isinstance(module, torch.nn.Module):
            raise ValueError(f"module = {module!r}: must be a torch.nn.Module")
        parameters = list(module.parameters())
        if not parameters:
            raise ValueError(f"module = {module!r}: must have parameters to train")
        if optimizer is None:
            optimizer = torch.optim.SGD(parameters, lr=0.1)
        elif not isinstance(optimizer, torch.optim.Optimizer) and callable(optimizer):
            optimizer = optimizer(parameters)
        if not isinstance(optimizer, torch.optim.Optimizer):
            raise ValueError(
                f"optimizer = {optimizer!r}: must be a torch optimiser, or a function that makes "
                "one from parameters"
            )
        own = {id(parameter) for parameter in parameters}
        if not own.issuperset(id(p) for group in optimizer.param_groups for p in group["params"]):
            raise ValueError(
                "optimizer: must be on the parameters of the module; use its parameters()"
            )
        model = _Module(module, optimizer, checks.whole("steps", steps, 1))
        self._set_up(type(module).__name__, model, **options)

    def _unwrapped(self, model: Any) -> Any:
        return model.module.eval()


class _Module:
    # Module and optimiser are copied together: the copied optimiser has the copied module's
    # parameters.
    def __init__(self, module: Any, optimizer: Any, steps: int) -> None:
        self.module, self.optimizer, self.steps = module, optimizer, steps
        self.dtype = next(module.parameters()).dtype

    def learn(self, features: Matrix, targets: Vector) -> None:
        torch = import_extra("torch", "torch", "a PyTorch learner")
        rows, wanted = (torch.from_numpy(array).to(self.dtype) for array in (features, targets))
        self.module.train()
        for _ in range(self.steps):
            self.optimizer.zero_grad()
            output = self.module(rows)
            if tuple(output.shape) not in ((len(wanted), 1), (len(wanted),)):
                raise ValueError(
                    f"returned shape {tuple(output.shape)} for {len(wanted)} rows: "
                    "must be one number for each"
                )
            torch.nn.functional.mse_loss(output.reshape(-1), wanted).backward()
            self.optimizer.step()

    def predict(self, features: Vector) -> Any:
        torch = import_extra("torch", "torch", "a PyTorch learner")
        self.module.eval()
        with torch.no_grad():
            row = torch.from_numpy(features.reshape(1, -1)).to(self.dtype)
            return self.module(row).numpy()

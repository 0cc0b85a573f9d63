"""Range and radio models by name: shipped ones, and classes of the user (see `class_loader`)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from compose.errors import FAILED, UserError, no_such, user_code, within
from compose.launch import class_loader
from world.radio_models import RADIO_MODELS
from world.range_models import RANGE_MODELS
from world.scenario import Scenario
from world.world_models import OWN_MODELS, ModelSpec, RadioModel, RangeModel

MODEL_KINDS: dict[str, tuple[type, dict[str, Any]]] = {
    "range": (RangeModel, RANGE_MODELS),
    "radio": (RadioModel, RADIO_MODELS),
}
"""The contract and the shipped models of each kind."""


def check(kind: str, spec: ModelSpec) -> None:
    """Load a model, and create it.

    Raises UserError, whose text begins with the field of the model's table, if that is not possible, or not
    permitted.
    """
    contract, shipped = MODEL_KINDS[kind]
    if spec.model in shipped:
        maker = shipped[spec.model]
    elif ":" not in spec.model:
        why = no_such(spec.model, shipped, "; a model of your own is MODULE:CLASS")
        raise UserError(f"model: {why}")
    else:
        with within("model: ", UserError):
            maker = _loaded(spec.model)
        if not issubclass(maker, contract):
            raise UserError(f"model: {spec.model} is not a subclass of tandem.models.{contract.__name__}")
    with user_code(f"options: {spec.model} cannot be created:"):
        maker(**spec.options)


def trust(name: str) -> type:
    """Load the class of a model that the user of this process has named. Raises UserError."""
    class_loader.trust(name)
    return _loaded(name)


def _loaded(name: str) -> type:
    found = class_loader.named(name, "model")
    if not isinstance(found, type) or not issubclass(found, RangeModel | RadioModel):
        raise UserError(f"{name} is not a range model or a radio model")
    OWN_MODELS[name] = _guarded(name, found)
    return found


def _guarded(name: str, model: type) -> type:
    """Return a subclass of `model` whose methods raise UserError, in one line, for whatever they raise."""

    def guarded(method: str) -> Callable[..., Any]:
        def called(self: Any, *arguments: Any) -> Any:
            with user_code(f"the model {name}: {method}() raises", FAILED):
                return getattr(super(subclass, self), method)(*arguments)

        return called

    methods = [one for one in ("detects", "measured", "start", "sent") if hasattr(model, one)]
    subclass = type(model.__name__, (model,), {one: guarded(one) for one in methods})
    return subclass


def trust_all(scenario: Scenario) -> None:
    """Load the models of a scenario that the user has named, in a process that a launcher started."""
    for spec in (scenario.range_model, scenario.radio_model):
        if spec is not None and ":" in spec.model:
            trust(spec.model)

"""Which effects a frame runs: only those that its picture needs and its scene calls for, and what that costs.

An effect is a pure function. Its parameters are what it reads; a parameter with a default is an optional read. The plan
walks back from the wanted resource; an effect that its scene does not call for is left out with its reason and a bound.
All that is left out because it would hardly be seen shares one allowance, so that no pixel changes by more than that.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from inspect import Parameter, signature
from typing import Any, Generic, TypeVar

from protocol.messages import LeftOut, Plan
from server.culling.reason import ALLOWANCE, CullReason

Facts = TypeVar("Facts")


def _never(_: Any) -> None:
    return None


@dataclass(frozen=True)
class Effect(Generic[Facts]):
    """A function of resources that writes one resource."""

    run: Callable[..., Any]
    writes: str
    omitted: Callable[[Facts], CullReason | None] = _never
    """Where it cannot run, or was asked not to: whatever that changes."""
    needless: Callable[[Facts], CullReason | None] = _never
    """Where leaving it out changes no more than is said. None where the scene calls for the effect."""
    through: Callable[..., Any] | None = None
    """A function that `run` hands its keywords on to: what that reads, the effect reads."""
    reads: tuple[str, ...] = field(init=False)
    optional: frozenset[str] = field(init=False)

    def __post_init__(self) -> None:
        functions = (self.run,) if self.through is None else (self.run, self.through)
        parameters = {p.name: p for f in functions for p in signature(f).parameters.values() if p.kind != p.VAR_KEYWORD}
        object.__setattr__(self, "reads", tuple(parameters))
        optional = (name for name, p in parameters.items() if p.default is not Parameter.empty)
        object.__setattr__(self, "optional", frozenset(optional))

    @property
    def name(self) -> str:
        """The function's name."""
        return self.run.__name__


class PlanError(LookupError):
    """The table of effects cannot make what is wanted."""


class _Allowance:
    """What may still change; the same omission is asked for by several effects and granted to all or none of them."""

    def __init__(self, left: float | None) -> None:
        """`left`: None grants nothing."""
        self._left = left
        self._granted: dict[CullReason, bool] = {}

    def grants(self, omission: CullReason) -> bool:
        if self._left is None:
            return False
        if omission not in self._granted:
            self._granted[omission] = omission.error_bound <= self._left
            self._left -= omission.error_bound if self._granted[omission] else 0.0
        return self._granted[omission]


def make_plan(
    effects: Sequence[Effect[Facts]],
    wanted: str,
    given: Collection[str],
    facts: Facts,
    *,
    everything: bool = False,
    stages: Mapping[str, CullReason] | None = None,
) -> tuple[list[Effect[Facts]], Plan]:
    """Effects that make `wanted` from `given` in order, and the plan that says what was left out.

    `everything`: effects that are needless run too. `stages`: what was left out before the effects; the allowance is
    theirs too. Raises PlanError if two effects write one resource, one is missing,
    or they need each other.
    """
    writers = {effect.writes: effect for effect in effects}
    if len(writers) != len(effects):
        raise PlanError("two effects write one resource")
    before = dict(stages or {})
    allowance = _Allowance(None if everything else ALLOWANCE - sum(o.error_bound for o in {*before.values()}))
    left_out: dict[str, CullReason] = {}
    order: list[Effect[Facts]] = []
    path: list[str] = []

    def omission_of(effect: Effect[Facts]) -> CullReason | None:
        if effect.writes in left_out:
            return left_out[effect.writes]
        needless = None if everything else effect.needless(facts)
        if needless is not None and allowance.grants(needless):
            return needless
        return effect.omitted(facts)

    def visit(resource: str, *, optional: bool) -> bool:
        """Whether `resource` will be there; appends what makes it to `order`."""
        if resource in given or any(effect.writes == resource for effect in order):
            return True
        if resource in path:
            raise PlanError(" -> ".join([*path, resource]))
        effect = writers.get(resource)
        omission = omission_of(effect) if effect else None
        if effect is None or omission is not None:
            if omission is not None:
                left_out[resource] = omission
            if optional:
                return False
            raise PlanError(f"nothing writes {resource!r}, wanted by {path[-1] if path else 'the caller'!r}")
        path.append(resource)
        for name in effect.reads:
            visit(name, optional=name in effect.optional)
        path.pop()
        order.append(effect)
        return True

    visit(wanted, optional=False)
    names = {effect.writes: effect.name for effect in effects}
    plan = Plan(
        run=tuple(effect.name for effect in order),
        left_out=tuple(
            LeftOut(effect=names.get(what, what), reason=omission.reason, error_bound=omission.error_bound)
            for what, omission in (before | left_out).items()
        ),
    )
    return order, plan


def execute(order: Sequence[Effect[Facts]], given: Mapping[str, Any], wanted: str) -> Any:
    """Run the planned effects; returns the wanted resource."""
    resources = dict(given)
    for effect in order:
        resources[effect.writes] = effect.run(**{name: resources[name] for name in effect.reads if name in resources})
    return resources[wanted]

"""Which effects a frame runs: only those that its picture needs and its scene calls for.

An effect is a pure function. It reads the types of its parameters and writes the type that it returns (resources.py). A
parameter that may be None is an optional read. The plan walks back from the target. An effect is left out

- where a required resource is absent, for the reason that this is,
- where one of its own `disabled_by` rules says so: something was asked for, or there is nothing to do,
- where one of its own `culled_by` rules bounds the change by less than is left of the frame's ALLOWANCE.

All that is left out with a bound shares the one allowance, so that no pixel changes by more than that.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from types import NoneType, UnionType
from typing import Any, Generic, TypeVar, Union, get_args, get_origin, get_type_hints

from protocol.messages import LeftOut, Plan
from server.culling.reason import ALLOWANCE, CullReason

Facts = TypeVar("Facts")
T = TypeVar("T")
Resource = Any
"""A class or a NewType."""
Rule = Callable[[Facts], CullReason | None]


@dataclass(frozen=True)
class Read:
    """One parameter of an effect, or one field of the target."""

    name: str
    resource: Resource
    is_optional: bool


@dataclass(frozen=True)
class Effect(Generic[Facts]):
    """A function of resources, and the scenes that do not call for it."""

    run: Callable[..., Any]
    disabled_by: tuple[Rule[Facts], ...] = ()
    """Rules that hold whatever they change: the effect was switched off, or has nothing to work on."""
    culled_by: tuple[Rule[Facts], ...] = ()
    """Rules whose bound must fit into the allowance."""

    @property
    def name(self) -> str:
        """The function's name."""
        return self.run.__name__

    @cached_property
    def reads(self) -> tuple[Read, ...]:
        """Its parameters."""
        return _reads({name: hint for name, hint in get_type_hints(self.run).items() if name != "return"})

    @cached_property
    def writes(self) -> Resource:
        """What it returns."""
        return get_type_hints(self.run)["return"]


@dataclass(frozen=True)
class Approximation(Generic[Facts]):
    """A given resource with two values; the coarse one is taken where its bound fits into the allowance."""

    name: str
    exact: object
    coarse: object
    bound: Callable[[Facts], CullReason]

    @property
    def resource(self) -> Resource:
        """The type of both values."""
        return type(self.exact)


class PlanError(LookupError):
    """The table of effects cannot make the target."""


@dataclass(frozen=True)
class EffectTable(Generic[Facts]):
    """Make a table of effects. Raises PlanError if two of them write the same resource."""

    effects: tuple[Effect[Facts], ...]
    approximations: tuple[Approximation[Facts], ...] = ()
    writers: dict[Resource, Effect[Facts]] = field(init=False)
    choices: dict[Resource, Approximation[Facts]] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "writers", {effect.writes: effect for effect in self.effects})
        object.__setattr__(self, "choices", {choice.resource: choice for choice in self.approximations})
        if len(self.writers) != len(self.effects):
            raise PlanError("two effects write one resource")


@dataclass(frozen=True)
class EffectPlan(Generic[T]):
    """The effects of one frame in order, and the values that the plan chose."""

    target: type[T]
    order: tuple[Effect[Any], ...]
    chosen: Mapping[Resource, object]
    left_out: tuple[LeftOut, ...]

    def described(self, *ends: str) -> Plan:
        """The plan as a message; `ends`: names of the effects that run last."""
        return Plan(run=(*(effect.name for effect in self.order), *ends), left_out=self.left_out)

    def execute(self, given: Mapping[Resource, object]) -> T:
        """Run the effects; `given` as for make_plan."""
        there = {resource: value for resource, value in given.items() if not isinstance(value, CullReason)}
        there |= self.chosen
        for effect in self.order:
            there[effect.writes] = run_effect(effect, _arguments(effect.reads, there))
        return self.target(**_arguments(target_reads(self.target), there))


def run_effect(effect: Effect[Any], arguments: Mapping[str, Any]) -> object:
    """The one place where effects are called: timers and test doubles attach here."""
    return effect.run(**arguments)


def make_plan(
    table: EffectTable[Facts],
    target: type[T],
    given: Mapping[Resource, object],
    facts: Facts,
    *,
    everything: bool = False,
    stages: Mapping[str, CullReason] | None = None,
) -> EffectPlan[T]:
    """The plan that makes the fields of the dataclass `target`.

    given: values by their resource; a CullReason in place of a value says why it is absent.
    everything: nothing is culled by a bound. stages: what was left out before the effects; the allowance is theirs too.
    Raises PlanError if nothing writes a resource, or effects need each other.
    """
    return _Planner(table, given, facts, everything, dict(stages or {})).plan(target)


class _Planner(Generic[Facts]):
    """The walk for one frame."""

    def __init__(
        self,
        table: EffectTable[Facts],
        given: Mapping[Resource, object],
        facts: Facts,
        everything: bool,
        stages: dict[str, CullReason],
    ) -> None:
        self._table, self._given, self._facts, self._stages = table, given, facts, stages
        self._allowance = None if everything else ALLOWANCE - sum(reason.error_bound for reason in {*stages.values()})
        self._granted: dict[CullReason, bool] = {}
        self._verdicts: dict[Resource, CullReason | None] = {}
        self._path: list[str] = []
        self._order: list[Effect[Facts]] = []
        self._chosen: dict[Resource, object] = {}
        self._coarse: dict[Resource, dict[str, CullReason]] = {}
        self._left_out: dict[str, CullReason] = {}

    def plan(self, target: type[T]) -> EffectPlan[T]:
        reads = target_reads(target)
        for read in reads:
            self._judge(read.resource)
        self._collect(reads)
        left_out = tuple(
            LeftOut(effect=name, reason=why.reason, error_bound=why.error_bound)
            for name, why in (self._stages | self._left_out).items()
        )
        return EffectPlan(target, tuple(self._order), self._chosen, left_out)

    def _judge(self, resource: Resource) -> CullReason | None:
        """Why a resource is absent; None where it will be there."""
        if resource in self._given:
            value = self._given[resource]
            return value if isinstance(value, CullReason) else None
        if resource not in self._verdicts:
            name = _name(resource)
            if name in self._path:
                raise PlanError(" -> ".join([*self._path, name]))
            self._path.append(name)
            self._verdicts[resource] = self._judge_written(resource)
            self._path.pop()
        return self._verdicts[resource]

    def _judge_written(self, resource: Resource) -> CullReason | None:
        if resource in self._table.choices:
            self._choose(self._table.choices[resource])
            return None
        effect = self._table.writers.get(resource)
        if effect is None:
            asker = self._path[-2] if len(self._path) > 1 else "the caller"
            raise PlanError(f"nothing writes {_name(resource)}, wanted by {asker}")
        reason = self._impossible(effect) or self._culled(effect)
        for read in effect.reads if reason is None else ():
            absent = self._judge(read.resource)
            if absent is not None and not read.is_optional:
                return absent
        return reason

    def _impossible(self, effect: Effect[Facts]) -> CullReason | None:
        """Why an effect cannot run or was switched off, without a look at any bound."""
        for read in effect.reads:
            value = self._given.get(read.resource)
            if isinstance(value, CullReason) and not read.is_optional:
                return value
        return next(filter(None, (rule(self._facts) for rule in effect.disabled_by)), None)

    def _culled(self, effect: Effect[Facts]) -> CullReason | None:
        for rule in effect.culled_by if self._allowance is not None else ():
            reason = rule(self._facts)
            if reason is not None and self._grants(reason):
                return reason
        return None

    def _grants(self, reason: CullReason) -> bool:
        """The same reason is granted to all effects or to none, and counted once."""
        if self._allowance is None:
            return False
        if reason not in self._granted:
            self._granted[reason] = reason.error_bound <= self._allowance
            self._allowance -= reason.error_bound if self._granted[reason] else 0.0
        return self._granted[reason]

    def _collect(self, reads: Sequence[Read]) -> None:
        """Append the effects that make `reads`, each after those that it needs; note what is left out."""
        for read in reads:
            effect = self._table.writers.get(read.resource)
            if read.resource in self._given or effect in self._order:
                continue
            if effect is None:
                self._left_out |= self._coarse.get(read.resource, {})
            elif (reason := self._verdicts[read.resource]) is not None:
                self._left_out[effect.name] = reason
            else:
                self._collect(effect.reads)
                self._order.append(effect)

    def _choose(self, choice: Approximation[Facts]) -> None:
        reason = choice.bound(self._facts)
        is_coarse = self._grants(reason)
        self._chosen[choice.resource] = choice.coarse if is_coarse else choice.exact
        if is_coarse:
            self._coarse[choice.resource] = {choice.name: reason}


_READS_OF: dict[type[Any], tuple[Read, ...]] = {}


def target_reads(target: type[Any]) -> tuple[Read, ...]:
    """The fields of a dataclass as reads; found once, because hints are text that has to be compiled."""
    if target not in _READS_OF:
        hints = get_type_hints(target)
        _READS_OF[target] = _reads({f.name: hints[f.name] for f in fields(target)})
    return _READS_OF[target]


def _reads(hints: Mapping[str, Any]) -> tuple[Read, ...]:
    reads = []
    for name, hint in hints.items():
        choices = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
        resource = next(choice for choice in choices if choice is not NoneType)
        reads.append(Read(name, resource, NoneType in choices))
    return tuple(reads)


def _arguments(reads: Sequence[Read], there: Mapping[Resource, object]) -> dict[str, object]:
    return {read.name: there.get(read.resource) for read in reads}


def _name(resource: Resource) -> str:
    return str(resource.__name__)

"""Executes state tables, ``{state: {input: (action, next state)}}``. Sans-IO.

A class with such a table names it ``TABLE``, and keeps its state. Its actions are functions of one signature; the
caller passes what they need.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
State = TypeVar("State")
Input = TypeVar("Input")
Result = TypeVar("Result")


def step(
    table: Mapping[State, Mapping[Input, tuple[Callable[P, Result], State | None]]],
    state: State,
    given: Input,
    *arguments: P.args,
    **options: P.kwargs,
) -> tuple[State, Result | None]:
    """Carry out the action that the table has for an input; return the next state, and what the action returned.

    A pair that the table lacks changes nothing. None as the next state: the state stays. An action that raises leaves
    the state to the caller, who has not stored a new one.
    """
    entry = table[state].get(given)
    if entry is None:
        return state, None
    action, after = entry
    result = action(*arguments, **options)
    return (state if after is None else after), result

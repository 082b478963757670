"""What the code of a function does, from its byte code, which travels to other processes.

Python's compiler writes docstrings, annotations and line numbers into code objects, and joins
instructions that are on one line. All this is left out. Other minor versions of Python have other
byte code.
"""

import dis
import inspect
from bisect import bisect_left
from collections.abc import Iterator
from functools import lru_cache
from types import CodeType
from typing import Any, NamedTuple

_KINDS = (
    inspect.CO_VARARGS | inspect.CO_VARKEYWORDS | inspect.CO_GENERATOR | inspect.CO_COROUTINE
    | inspect.CO_ASYNC_GENERATOR
)  # fmt: skip
"""Flags of a code that change what a call does."""
_IDLE = {"NOP", "RESUME", "CACHE", "EXTENDED_ARG", "PUSH_NULL"}
"""Instructions without an effect of their own.

Whether PUSH_NULL comes with a call of an attribute depends on the other code of a module or cell.
"""
_CLOSURE = 8
_ANNOTATIONS = 4 | 16
"""Flags of functions that are made with annotations; 16 is that of Python 3.14."""
_OF_CLASS = {"__doc__", "__firstlineno__", "__static_attributes__"}
"""Names in the body of a class that Python sets by itself, or that are its docstring."""
_OF_GLOBALS = {"LOAD_GLOBAL", "LOAD_NAME", "LOAD_FROM_DICT_OR_GLOBALS"}
_OF_ATTRIBUTES = {"LOAD_ATTR", "LOAD_METHOD"}


type Step = tuple[str, Any]
"""An instruction, with its constant, name, position of the next step, or number."""


class Read(NamedTuple):
    """A global variable, or one of an enclosing function, with the attributes that are read."""

    name: str
    attributes: tuple[str, ...]
    is_global: bool


def parts_of(code: CodeType) -> tuple[Any, ...]:
    """Return what a code does: its arguments, its steps, and where exceptions are handled."""
    n_arguments = code.co_argcount + code.co_kwonlyargcount
    n_arguments += bool(code.co_flags & inspect.CO_VARARGS)
    n_arguments += bool(code.co_flags & inspect.CO_VARKEYWORDS)
    counts = code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount
    return (
        *counts, code.co_flags & _KINDS, code.co_varnames[:n_arguments], *_steps_and_handlers(code)
    )  # fmt: skip


def reads_of(code: CodeType) -> list[Read]:
    """Return the variables from outside that a code and its inner functions read, sorted."""
    found: set[Read] = set()
    steps, _ = _steps_and_handlers(code)
    for k, (name, value) in enumerate(steps):
        if isinstance(value, CodeType):
            found |= set(reads_of(value))
        elif name in _OF_GLOBALS or name == "LOAD_DEREF":
            found.add(Read(value, _attributes_after(steps, k), name in _OF_GLOBALS))
    return sorted(found)


class Import(NamedTuple):
    """An import in a function: the module, the names from it, and all attributes that are read."""

    module: str
    level: int
    names: tuple[str, ...]
    attributes: tuple[str, ...]


def imports_of(code: CodeType) -> Iterator[Import]:
    """Yield the imports in a code and its inner functions."""
    steps, _ = _steps_and_handlers(code)
    read = tuple(sorted({value for name, value in steps if name in _OF_ATTRIBUTES}))
    for k, (name, value) in enumerate(steps):
        if isinstance(value, CodeType):
            yield from imports_of(value)
        elif name == "IMPORT_NAME":
            (_, level), (_, names) = steps[k - 2 : k]
            yield Import(value, level, names or (), read)


def _attributes_after(steps: tuple[Step, ...], k: int) -> tuple[str, ...]:
    """Return the names of the attributes that are read one after the other after step k."""
    names = []
    for name, value in steps[k + 1 :]:
        if name not in _OF_ATTRIBUTES:
            break
        names.append(value)
    return tuple(names)


@lru_cache(maxsize=1024)
def _steps_and_handlers(code: CodeType) -> tuple[tuple[Step, ...], tuple[Any, ...]]:
    """Return the steps of a code, and (start, end, handler, depth, lasti) of exceptions."""
    bytecode = dis.Bytecode(code)
    instructions = [one for one in bytecode if one.opname not in ("CACHE", "EXTENDED_ARG")]
    left_out = _annotations_in(instructions) | _of_class_in(instructions)

    kept: list[dis.Instruction] = []
    position: dict[int, int] = {}  # of the next step, by the offset of an instruction
    n_steps = 0
    for k, one in enumerate(instructions):
        position[one.offset] = n_steps
        if k not in left_out and one.opname not in _IDLE:
            kept.append(one)
            n_steps += len(_split(one, {}))
    offsets = [*position]

    def place(offset: int) -> int:
        """Return the position of the step at an offset, or of the next one."""
        k = bisect_left(offsets, offset)
        return position[offsets[k]] if k < len(offsets) else n_steps

    places = {one.argval: place(one.argval) for one in kept if _jumps(one)}
    steps = tuple(step for one in kept for step in _split(one, places))
    handlers = tuple(
        (place(e.start), place(e.end), place(e.target), e.depth, e.lasti)
        for e in bytecode.exception_entries  # pyright: ignore[reportAttributeAccessIssue]
    )
    return steps, handlers


def _split(one: dis.Instruction, places: dict[int, int]) -> list[Step]:
    """Return an instruction as steps; Python joins two instructions that are on one line."""
    if _jumps(one):
        return [(one.opname, places.get(one.argval))]
    name = one.opname.replace("_BORROW", "")
    if isinstance(one.argval, tuple) and one.opcode in dis.haslocal:
        parts = name.replace("_FAST_", "_FAST ").split(" ")
        return [(part, value) for part, value in zip(parts, one.argval, strict=True)]
    if name == "MAKE_FUNCTION":
        return [(name, (one.arg or 0) & ~_ANNOTATIONS)]
    if one.opcode in (*dis.hasconst, *dis.hasname, *dis.haslocal, *dis.hasfree):
        return [(name, one.argval)]
    return [(name, one.arg)]


def _jumps(one: dis.Instruction) -> bool:
    """Return whether the argument of an instruction is the offset of another one."""
    return one.opcode in dis.hasjrel or one.opcode in dis.hasjabs


def _annotations_in(instructions: list[dis.Instruction]) -> set[int]:
    """Return the indices of instructions that make annotations of inner functions."""
    left_out = set()
    for k, one in enumerate(instructions):
        if one.opname != "MAKE_FUNCTION":
            continue
        after = []  # since Python 3.13, attributes are set by instructions of their own
        for n in range(k + 1, len(instructions)):
            if instructions[n].opname != "SET_FUNCTION_ATTRIBUTE":
                break
            after.append(n)

        flags = [one.arg or 0, *(instructions[n].arg or 0 for n in after)]
        if not any(flag & _ANNOTATIONS for flag in flags):
            continue
        end = k - 1  # of the annotations: the code comes last, and its closure before it
        if any(flag & _CLOSURE for flag in flags):
            end = _begin_of_value(instructions, end)
        left_out |= set(range(_begin_of_value(instructions, end), end))
        left_out |= {n for n in after if (instructions[n].arg or 0) & _ANNOTATIONS}
    return left_out


def _begin_of_value(instructions: list[dis.Instruction], end: int) -> int:
    """Return the index of the first instruction of those that make the value before `end`."""
    height = 0
    for k in range(end - 1, -1, -1):
        one = instructions[k]
        height += dis.stack_effect(one.opcode, one.arg, jump=False)
        if height == 1:
            return k
    return end


def _of_class_in(instructions: list[dis.Instruction]) -> set[int]:
    """Return the indices of instructions that set docstrings and line numbers of classes."""
    left_out = set()
    for k, one in enumerate(instructions):
        if one.opname == "STORE_NAME" and one.argval in _OF_CLASS:
            left_out |= {k - 1, k}
    return left_out

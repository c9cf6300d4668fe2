"""Generates TypeScript definitions from the Python messages: `python -m protocol.typescript` rewrites protocol.ts.

Interfaces with a literal `type` tag, so that `switch (message.type)` over the unions is checked for completeness.
A field with a default may be left out of what a client sends; the server always writes every field.
"""

from __future__ import annotations

import ast
import inspect
import json
import sys
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path
from textwrap import dedent
from typing import get_args

from msgspec import inspect as types

from protocol import limits
from protocol.messages import ClientMessage, ServerMessage

OUTPUT = Path(__file__).resolve().parents[1] / "client" / "web" / "src" / "protocol.ts"
HEADER = "// Generated from protocol/messages.py by `python -m protocol.typescript`. Do not edit.\n"


def render() -> str:
    """The whole of protocol.ts."""
    client = structs_of(get_args(ClientMessage))
    server = structs_of(get_args(ServerMessage))
    interfaces = [_interface(struct, sent=struct in client) for struct in dict.fromkeys([*client, *server])]
    unions = [_union("ClientMessage", ClientMessage), _union("ServerMessage", ServerMessage)]
    return "\n".join([HEADER, *_constants(), "", *interfaces, *unions])


def _constants() -> Iterator[str]:
    for name, value in vars(limits).items():
        if name.isupper():
            yield f"export const {name} = {json.dumps(value)};"


def structs_of(classes: tuple[type, ...]) -> list[type]:
    """`classes` and all structs used in their fields, each after the structs that it uses."""
    found: dict[type, None] = {}

    def visit(node: types.Type) -> None:
        if isinstance(node, types.StructType):
            for field in node.fields:
                visit(field.type)
            found.setdefault(node.cls)
        for child in _children(node):
            visit(child)

    for cls in classes:
        visit(plain(types.type_info(cls)))
    return list(found)


def _children(node: types.Type) -> tuple[types.Type, ...]:
    match node:
        case types.Metadata(type=inner):
            return (inner,)
        case types.UnionType(types=several) | types.TupleType(item_types=several):
            return several
        case types.VarTupleType(item_type=item) | types.ListType(item_type=item):
            return (item,)
    return ()


def _interface(cls: type, sent: bool) -> str:
    info = plain(types.type_info(cls))
    assert isinstance(info, types.StructType)
    docs = field_docs(cls)
    lines = [*_doc(inspect.getdoc(cls), ""), f"export interface {cls.__name__} {{"]
    if info.tag is not None:
        lines.append(f"  {info.tag_field}: {json.dumps(info.tag)};")
    for field in info.fields:
        optional = "?" if sent and not field.required else ""
        lines += [*_doc(docs.get(field.name), "  "), f"  {field.encode_name}{optional}: {_type(field.type)};"]
    return "\n".join([*lines, "}", ""])


def _type(node: types.Type) -> str:
    match node:
        case types.Metadata(type=inner):
            return _type(inner)
        case types.StructType(cls=cls):
            return cls.__name__
        case types.LiteralType(values=values):
            return " | ".join(json.dumps(value) for value in values)
    return _SCALARS[type(node)] if type(node) in _SCALARS else _compound(node)


def _compound(node: types.Type) -> str:
    match node:
        case types.UnionType(types=several):
            return " | ".join(_type(one) for one in several)
        case types.TupleType(item_types=several):
            return f"[{', '.join(_type(one) for one in several)}]"
        case types.VarTupleType(item_type=item) | types.ListType(item_type=item):
            return f"Array<{_type(item)}>"
    raise TypeError(f"no TypeScript for a field of {type(node).__name__}")


_SCALARS: dict[type[types.Type], str] = {
    types.IntType: "number",
    types.FloatType: "number",
    types.StrType: "string",
    types.BoolType: "boolean",
    types.BytesType: "Uint8Array",
    types.NoneType: "null",
}


def _union(name: str, union: object) -> str:
    members = "".join(f"\n  | {cls.__name__}" for cls in get_args(union))
    return f"export type {name} ={members};\n"


def _doc(text: str | None, indent: str) -> list[str]:
    if not text:
        return []
    lines = text.strip().replace("None", "null").splitlines()
    if len(lines) == 1:
        return [f"{indent}/** {lines[0]} */"]
    return [f"{indent}/**", *(f"{indent} * {line}".rstrip() for line in lines), f"{indent} */"]


def field_docs(cls: type) -> dict[str, str]:
    """The docstring that follows a field in the class body, by field name; base classes first."""
    docs: dict[str, str] = {}
    for base in reversed([base for base in cls.__mro__ if base.__module__.startswith("protocol.")]):
        body = _class_body(base)
        for field, doc in pairwise(body):
            match field, doc:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                    docs[name] = inspect.cleandoc(text)
    return docs


@cache
def _class_body(cls: type) -> list[ast.stmt]:
    definition = ast.parse(dedent(inspect.getsource(cls))).body[0]
    assert isinstance(definition, ast.ClassDef)
    return definition.body


def plain(node: types.Type) -> types.Type:
    return plain(node.type) if isinstance(node, types.Metadata) else node


def main() -> None:
    """Write protocol.ts."""
    OUTPUT.parent.mkdir(parents=True, exist_ok=True)
    OUTPUT.write_text(render(), encoding="utf-8")
    sys.stdout.write(f"wrote {OUTPUT}\n")


if __name__ == "__main__":
    main()

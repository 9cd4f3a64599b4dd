"""Shapes in the signatures of the API page as they stand in the source: `Float[Array, "T *batch"]`, not a product of T and batch."""

import ast
from typing import Any

import griffe


class Shapes(griffe.Extension):
    """Leaves strings inside annotations alone, which are taken for the names of types otherwise."""

    def on_function_instance(self, *, node: Any, func: griffe.Function, **_: Any) -> None:
        """Read the annotations of a function again."""
        if not isinstance(node, ast.FunctionDef):
            return
        scope: Any = func.parent
        arguments = node.args
        for argument in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs):
            if argument.annotation:
                func.parameters[argument.arg].annotation = griffe.get_expression(
                    argument.annotation, scope, parse_strings=False
                )
        if node.returns:
            func.returns = griffe.get_expression(node.returns, scope, parse_strings=False)

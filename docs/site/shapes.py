"""Shapes in signatures of the API page as they are in the source."""

import ast
from typing import Any

import griffe


class Shapes(griffe.Extension):
    """Leave strings inside annotations alone; they would be taken for names of types."""

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

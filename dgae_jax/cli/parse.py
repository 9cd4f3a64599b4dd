"""The frame of all commands: flags by tyro, mistakes as one message and exit code 2.

Nothing here imports JAX, so that a mistake is refused in under a second.
"""

import contextlib
import dataclasses
import functools
import inspect
import io
import math
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, NamedTuple, NoReturn, get_args

import tyro
from tyro import constructors

from dgae_jax.configs.config import (
    Config,
    ConfigError,
    CriticConfig,
    FitConfig,
    PolicyConfig,
    flag,
    invalid,
)
from dgae_jax.run import directory, terminal


@dataclasses.dataclass(frozen=True)
class Shared(FitConfig):
    """Settings of policy and critic at once, where the algorithm uses them."""

    hidden: tuple[int, ...] | None = None  # pyright: ignore[reportIncompatibleVariableOverride]
    """Width of each hidden layer [units]."""

    def apply(self, config: Config) -> Config:
        """Return `config` with these settings where it uses them."""
        for name, value in vars(self).items():
            for path in (f"policy.{name}", f"critic.{name}"):
                if value is not None and config.get(path) is not None:
                    config = config.replace(**{path: value})
        return config


ALIASES: dict[type, dict[str, str]] = {
    Config: {
        "env": "--env-id --env-name --task",
        "algo": "--algorithm --agent",
        "physics": "--engine --backend",
        "total_steps": "--total-timesteps --num-timesteps --timesteps",
        "num_envs": "--n-envs",
        "num_steps": "--n-steps --unroll-length --rollout-length --horizon",
        "episode_length": "--max-episode-steps --max-steps-in-episode",
        "gamma": "--discount --discounting",
        "gae_lambda": "--lambda --lam",
    },
    PolicyConfig: {
        "clip_eps": "--clip-eps --clip-coef --clip-range --clipping-epsilon --policy.clip",
        "max_kl": "--max-kl --target-kl --policy.radius",
        "damping": "--cg-damping",
        "cg_iterations": "--cg-max-steps",
        "max_backtracks": "--line-search-max-iter --policy.backtracks",
    },
    CriticConfig: {"quantiles": "--n-quantiles --num-quantiles"},
    Shared: {
        "learning_rate": "--lr",
        "epochs": "--num-epochs --n-epochs --update-epochs --num-updates-per-batch",
        "minibatches": "--num-minibatches --n-minibatches",
        "hidden": "--hidden-sizes --hidden-layer-sizes --layers",
    },
}
"""Names that settings have in other trainers, or had in former versions."""

_LISTED = object()
"""Mark of a dataclass that tyro's own rule is listing."""

registry = constructors.ConstructorRegistry()


@registry.struct_rule
def _with_aliases(info: constructors.StructTypeInfo) -> constructors.StructConstructorSpec | None:
    """Add aliases to the fields of dataclasses that know nothing of tyro, and refill their help."""
    if not dataclasses.is_dataclass(info.type) or _LISTED in info.markers:
        return None
    marked = dataclasses.replace(info, markers=(*info.markers, _LISTED))
    spec: Any = registry.get_struct_spec(marked)
    fields = []
    for field in spec.fields:
        kind = field.type
        if aliases := ALIASES.get(info.type, {}).get(field.name):
            kind = Annotated[kind, tyro.conf.arg(aliases=aliases.split())]
        fields.append(dataclasses.replace(field, type=kind))
    return dataclasses.replace(spec, fields=tuple(fields))


@registry.primitive_rule
def _optional(info: constructors.PrimitiveTypeInfo) -> Any:
    """Read `X | None` as X; None is the default of a flag that is unset."""
    kinds = [kind for kind in get_args(info.type) if kind is not NoneType]
    if NoneType not in get_args(info.type) or len(kinds) > 1:
        return None
    info = constructors.PrimitiveTypeInfo.make(kinds[0], info.markers)
    inner: Any = registry.get_primitive_spec(info)
    return dataclasses.replace(
        inner,
        is_instance=lambda value: value is None or inner.is_instance(value),
        str_from_instance=lambda x: ["unset"] if x is None else inner.str_from_instance(x),
    )


class _Names(tuple[str, ...]):
    """Choices in lower case, which are found in any case."""

    def __contains__(self, word: object) -> bool:
        return super().__contains__(str(word).lower())


@registry.primitive_rule
def _choice(info: constructors.PrimitiveTypeInfo) -> Any:
    """Read `PPO` and `Ppo` as `ppo`."""
    if info.type_origin is not Literal:
        return None
    names = _Names(get_args(info.type))
    return constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="{" + ",".join(names) + "}",
        instance_from_str=lambda words: words[0].lower(),
        is_instance=lambda value: value in names,
        str_from_instance=lambda value: [value],
        choices=names,
    )


def number(
    kind: type[int] | type[float], low: float = -math.inf, high: float = math.inf
) -> constructors.PrimitiveConstructorSpec[Any]:
    """Return how a number is read, a whole one also from `1e6`, and refused outside its range."""
    allowed = "a whole number" if kind is int else "a number"
    allowed += f" from {low:,} to {high:,}" if high < math.inf else ""

    def read(words: list[str]) -> Any:
        with contextlib.suppress(ValueError, OverflowError):
            value = float(words[0])
            if low <= value <= high and kind(value) == value:
                return kind(value)
        raise ValueError(f"{words[0]}: must be {allowed}")

    return constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar=kind.__name__.upper(),
        instance_from_str=read,
        is_instance=lambda value: type(value) is kind,
        str_from_instance=lambda value: [f"{value:_}"],
    )


@registry.primitive_rule
def _whole_number(info: constructors.PrimitiveTypeInfo) -> Any:
    return number(int) if info.type is int else None


def arguments(
    cls: Any, argv: Sequence[str], default: Any = tyro.MISSING_NONPROP, **options: Any
) -> Any:
    """Return the dataclass `cls` filled from the words of a command line, over `default`.

    Docstrings are the help. tyro prints it, or what is wrong with a flag, and exits with 0 or 2.
    """
    tyro._experimental_options["ansi_codes"] = not os.environ.get("NO_COLOR")
    options = {"description": inspect.getdoc(cls), **options}
    config = (tyro.conf.PositionalMetavarFromFieldName,)
    stdout: Any = terminal.Steady(sys.stdout)
    try:
        with contextlib.redirect_stdout(stdout):
            return tyro.cli(
                cls, args=argv, default=default, config=config, registry=registry, **options
            )
    except (AssertionError, OSError) as reason:  # of tyro's flags for completion
        fail(str(reason))


def peek(cls: Any, argv: Sequence[str]) -> Any:
    """Return the same without help and messages; None where there would be either."""
    words = [word for word in argv if word not in ("-h", "--help")]
    with contextlib.suppress(SystemExit), contextlib.redirect_stderr(io.StringIO()):
        return arguments(cls, words)
    return None


class Command(NamedTuple):
    """A command: the dataclass of its flags, the parser of a command line and what it does."""

    arguments: Any
    read: Callable[[list[str]], Any]
    work: Callable[[Any], int | None]

    def __call__(self) -> int:
        """Run on the command line of this process, and return the exit code."""
        terminal.prepare()
        try:
            return self.work(self.read(sys.argv[1:])) or 0
        except ConfigError as mistake:
            fail(mistake)
        except KeyboardInterrupt:
            terminal.warn("stopped by SIGINT")
            os._exit(130)  # Python would wait for XLA, or abort it


def command(
    cls: Any, read: Callable[[list[str]], Any] | None = None
) -> Callable[[Callable[[Any], int | None]], Command]:
    """Make a command of a function that takes `cls`, or what `read` makes of a command line."""
    return lambda work: Command(cls, read or functools.partial(arguments, cls), work)


def fail(mistake: Exception | str) -> NoReturn:
    """Print a mistake as one line, with a setting as its flag, and exit with 2."""
    message, setting = str(mistake), getattr(mistake, "setting", None)
    if setting and message.startswith(setting):
        message = flag(setting) + message[len(setting) :]
    line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in message)
    terminal.warn(f"error: {line}")
    raise SystemExit(2)


def require(package: str, extra: str) -> None:
    """Raise ConfigError, naming what to install, unless a package is here."""
    if find_spec(package) is None:
        raise ConfigError(f'{package} is not installed: pip install "dgae_jax[{extra}]"')


@contextlib.contextmanager
def writing(out: Path, kind: str = "file") -> Iterator[None]:
    """Raise ConfigError where `out` cannot be written: before the work, as far as can be seen."""
    with directory.must_be(f"a {kind} that can be written", out, "out"):
        is_other = out.exists() and not out.is_file()
        if kind == "file" and (is_other or not out.absolute().parent.is_dir()):
            raise invalid("out", out, "a file, new or not, in a directory that exists")
        yield

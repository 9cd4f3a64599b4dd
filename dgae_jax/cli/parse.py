"""The frame of all commands: flags by tyro, mistakes as one message and exit code 2.

Nothing here imports JAX, so that a mistake is refused in under a second.
"""

import contextlib
import dataclasses
import functools
import inspect
import io
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, NoReturn, TypeVar

import tyro
from tyro import constructors

from dgae_jax.configs.algorithms import ALGORITHMS, AlgorithmName
from dgae_jax.configs.config import Config, ConfigError, CriticConfig, PolicyConfig, flag, invalid
from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.run import terminal
from dgae_jax.run.options import RunOptions

T = TypeVar("T")

ALIASES = {
    "env": "--env-id --env-name --task",
    "algo": "--algorithm --agent",
    "physics": "--engine --backend",
    "total_steps": "--total-timesteps --num-timesteps --timesteps",
    "num_envs": "--n-envs",
    "num_steps": "--n-steps --unroll-length --rollout-length --horizon",
    "episode_length": "--max-episode-steps --max-steps-in-episode",
    "gamma": "--discount --discounting",
    "gae_lambda": "--lambda --lam",
    "policy.clip_eps": "--clip-eps --clip-coef --clip-range --clipping-epsilon --policy.clip",
    "policy.max_kl": "--max-kl --target-kl --policy.radius",
    "policy.damping": "--cg-damping",
    "policy.cg_iterations": "--cg-max-steps",
    "policy.max_backtracks": "--line-search-max-iter --policy.backtracks",
    "critic.quantiles": "--n-quantiles --num-quantiles",
    "shared.learning_rate": "--lr",
    "shared.epochs": "--num-epochs --n-epochs --update-epochs --num-updates-per-batch",
    "shared.minibatches": "--num-minibatches --n-minibatches",
    "shared.hidden": "--hidden-sizes --hidden-layer-sizes --layers",
}
"""Names that settings have in other trainers, or had in former versions."""


@dataclasses.dataclass(frozen=True)
class SharedSettings:
    """Settings of policy and critic at once, where the algorithm uses them."""

    learning_rate: float | None = None
    """Learning rate of policy and critic, unless one is given by itself [1]."""
    epochs: int | None = None
    """Passes of policy and critic over each rollout, unless one is given by itself [1]."""
    minibatches: int | None = None
    """Gradient steps of policy and critic per pass, unless one is given by itself [1]."""
    max_grad_norm: float | None = None
    """Largest norm of a gradient of policy and critic, unless one is given by itself [1]."""
    hidden: tuple[int, ...] | None = None
    """Width of the layers of policy and critic, unless one is given by itself [units]."""

    def apply(self, config: Config, start: Config) -> Config:
        """Return `config` with these settings where it uses them and has the value of `start`."""
        for name, value in vars(self).items():
            for path in (f"policy.{name}", f"critic.{name}"):
                is_usual = config.get(path) == start.get(path) is not None
                if value is not None and is_usual:
                    config = config.replace(**{path: value})
        return config


PREFIXES: dict[Any, str] = {
    Config: "",
    PolicyConfig: "policy.",
    CriticConfig: "critic.",
    SharedSettings: "shared.",
}
"""Dataclasses that have aliases, and what stands before their fields in `ALIASES`."""

_LISTED = object()
"""Mark of a dataclass that tyro's own rule is listing."""

registry = constructors.ConstructorRegistry()


@registry.struct_rule
def _with_aliases(info: constructors.StructTypeInfo) -> constructors.StructConstructorSpec | None:
    """Add aliases to the fields of dataclasses that know nothing of tyro, and refill their help."""
    if not dataclasses.is_dataclass(info.type) or _LISTED in info.markers:
        return None
    marked = dataclasses.replace(info, markers=(*info.markers, _LISTED))
    spec: Any = constructors.ConstructorRegistry.get_struct_spec(marked)
    fields = []
    for field in spec.fields:
        aliases = ALIASES.get(PREFIXES.get(info.type, "?") + field.name, "").split()
        kind: Any = Annotated[field.type, tyro.conf.arg(aliases=aliases)]
        text = functools.partial(_one_paragraph, field.helptext)
        kind = kind if aliases else field.type
        fields.append(dataclasses.replace(field, type=kind, helptext=text))
    return dataclasses.replace(spec, fields=tuple(fields))


def _one_paragraph(text: Callable[[], str | None]) -> str:
    return " ".join((text() or "").split())


@registry.primitive_rule
def _whole_number(info: constructors.PrimitiveTypeInfo) -> Any:
    """Read `1e6` where a number is whole."""
    if info.type is int:
        return constructors.PrimitiveConstructorSpec(
            nargs=1,
            metavar="INT",
            instance_from_str=lambda words: _to_int(words[0]),
            is_instance=lambda value: type(value) is int,
            str_from_instance=lambda value: [f"{value:_}"],
        )
    return None


def _to_int(word: str) -> int:
    with contextlib.suppress(ValueError):
        return int(word)
    with contextlib.suppress(ValueError):
        if float(word).is_integer() and abs(float(word)) < 1e15:
            return int(float(word))
    raise ValueError(f"{word}: must be a whole number")


@registry.primitive_rule
def _algorithm(info: constructors.PrimitiveTypeInfo) -> Any:
    """Read `PPO` as `ppo`."""
    if info.type == AlgorithmName:
        return constructors.PrimitiveConstructorSpec(
            nargs=1,
            metavar="{" + ",".join(ALGORITHMS) + "}",
            instance_from_str=lambda words: words[0].lower(),
            is_instance=lambda value: value in ALGORITHMS,
            str_from_instance=lambda value: [value],
            choices=(*ALGORITHMS, *map(str.upper, ALGORITHMS)),
        )
    return None


def arguments(
    cls: Any, argv: Sequence[str] | None = None, default: Any = None, **options: Any
) -> Any:
    """Return the dataclass `cls` filled from a command line.

    tyro prints the help, or what is wrong with a flag, and exits with 0 or 2.

    Args:
        cls: a dataclass; its docstring describes the command, those of its fields the flags.
        argv: the words after the command; those of this process by default.
        default: an instance of `cls` with the defaults.
        options: further arguments of `tyro.cli`.
    """
    tyro._experimental_options["ansi_codes"] = not os.environ.get("NO_COLOR")
    options = {"description": inspect.getdoc(cls), **options}
    if default is not None:
        options["default"] = default
    try:
        with contextlib.redirect_stdout(terminal.Steady(sys.stdout)):
            return tyro.cli(
                cls,
                args=sys.argv[1:] if argv is None else argv,
                config=(tyro.conf.PositionalMetavarFromFieldName,),
                registry=registry,
                **options,
            )
    except (AssertionError, OSError) as reason:  # of tyro's flags for completion
        fail(str(reason))


def peek(cls: type[T], argv: Sequence[str]) -> T | None:
    """Return the same without help and messages; None where there would be either."""
    words = [word for word in argv if word not in ("-h", "--help")]
    with contextlib.suppress(SystemExit), contextlib.redirect_stderr(io.StringIO()):
        return arguments(cls, words)
    return None


def flags_in(argv: Sequence[str]) -> set[str]:
    """Return the flags among the words of a command line; aliases are counted as their flag."""
    ours = {alias: flag(name) for name, aliases in ALIASES.items() for alias in aliases.split()}
    words = {word.partition("=")[0].replace("_", "-") for word in argv if word.startswith("--")}
    return {ours.get(word, word) for word in words}


def command(
    cls: Any, read: Callable[[list[str]], T] | None = None
) -> Callable[[Callable[[T], int | None]], Callable[[], int]]:
    """Make a command of a function that takes what `read` makes of a command line.

    The command returns the exit code: that of the function, 0 for None, 130 after SIGINT. It exits
    with 2 for a ConfigError.

    Args:
        cls: the dataclass of the flags.
        read: the parser; by default the function takes the dataclass.
    """

    def decorate(work: Callable[[T], int | None]) -> Callable[[], int]:
        @functools.wraps(work)
        def run() -> int:
            terminal.prepare()
            try:
                return work(read(sys.argv[1:]) if read else arguments(cls)) or 0
            except ConfigError as mistake:
                fail(mistake)
            except KeyboardInterrupt:
                return interrupted()

        run.arguments = cls  # pyright: ignore[reportFunctionMemberAccess]
        return run

    return decorate


def fail(mistake: Exception | str) -> NoReturn:
    """Print a mistake as one line, with a setting as its flag, and exit with 2."""
    message, setting = str(mistake), getattr(mistake, "setting", None)
    if setting and message.startswith(setting):
        message = flag(setting) + message[len(setting) :]
    line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in message)
    terminal.warn(f"error: {line}")
    raise SystemExit(2)


def interrupted() -> int:
    """Say that SIGINT ended the command; end here where a compiler would abort the process."""
    terminal.warn("stopped by SIGINT")
    runtime = sys.modules.get("dgae_jax.run.runtime")  # imported by now if JAX compiles
    if runtime and runtime.is_compiling():
        os._exit(130)
    return 130


def use_one_device(config: ResolvedConfig, cache_dir: str) -> None:
    """Start JAX on a single device, with a cache of compiled programs."""
    from dgae_jax.run import runtime

    runtime.use_devices(config, RunOptions(devices=1, num_processes=1))
    runtime.use_cache(cache_dir)


INT32 = (0, 2**31 - 1, "an int32")
"""Range of seeds."""


def check(args: Any, **ranges: tuple[int, int] | tuple[int, int, str]) -> None:
    """Raise ConfigError for a whole number outside its range: lowest, highest, and the reason."""
    for name, (low, high, *reason) in ranges.items():
        if not low <= (value := getattr(args, name)) <= high:
            why = f" ({reason[0]})" if reason else ""
            raise invalid(name, value, f"a whole number from {low:,} to {high:,}{why}")


@contextlib.contextmanager
def writing(out: Path, kind: str = "file") -> Iterator[None]:
    """Raise ConfigError where `out` cannot be written."""
    try:
        yield
    except OSError as reason:
        raise invalid("out", out, f"a {kind} that can be written ({reason.strerror})") from reason


def check_file(out: Path) -> None:
    """Raise ConfigError unless a file can be written there, as far as can be seen."""
    with writing(out):
        parent = out.absolute().parent
        if not parent.is_dir():
            raise invalid("out", out, "a file in a directory that exists")
        if out.is_symlink() or (out.exists() and not out.is_file()):
            raise invalid("out", out, "a file, not a directory, a link or a device")
        if not os.access(parent, os.W_OK):
            raise invalid("out", out, "a file that can be written")


def check_directory(out: Path) -> None:
    """Raise ConfigError unless a directory can be written or made there, as far as can be seen."""
    with writing(out, "directory"):
        above = next(path for path in (out.absolute(), *out.absolute().parents) if path.exists())
        if not (above.is_dir() and os.access(above, os.W_OK)):
            raise invalid("out", out, "a directory that can be written")

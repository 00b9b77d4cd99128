"""Choice of the hyperparameter λ by one rule, or by several rules that are compared on the same data."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from jeit.forward import ForwardModel
from jeit.inverse.hyperparameter.choice import DEFAULT_RULE, Choice
from jeit.inverse.hyperparameter.rules import RULES, Rule, choose
from jeit.inverse.linearisation import Linearisation
from jeit.inverse.prior.priors import AbstractPrior


def choose_hyperparameter(
    model: ForwardModel,
    conductivity: ArrayLike,
    *,
    rule: str | Rule = DEFAULT_RULE,
    prior: AbstractPrior | None = None,
    difference: Float[Array, " M"] | None = None,
    noise: Float[Array, " M"] | float = 1.0,
    mask: Bool[Array, " M"] | None = None,
) -> Choice:
    """Choose the λ that `one_step` would use with the same arguments, without computing the image. The choice can be
    passed to `one_step` as its hyperparameter.

    **Arguments:**

    - `model`: the forward model.
    - `conductivity`: the background, S/m (2-D: S).
    - `rule`: name of a rule in `jeit.inverse.RULES`, or a function of (spectrum, data, mesh) that returns a `Choice`,
      such as `functools.partial(noise_figure, target=0.5)`.
    - `prior`, `difference`, `noise`, `mask`: as in `one_step`.

    Raises `ValueError` for invalid or inconsistent arguments.

    **Example:**

    ```python
    choice = choose_hyperparameter(model, 1.0, rule="l-curve", difference=change, noise=1e-6)
    image = one_step(model, 1.0, hyperparameter=choice, noise=1e-6).image(change)
    ```
    """
    if not (isinstance(rule, str) or callable(rule)):
        raise ValueError(f"rule: give one of {', '.join(RULES)}, not {rule!r}; a number needs no choosing.")
    linearisation = Linearisation.create(model, conductivity, prior=prior, noise=noise, mask=mask)
    whitened_data = None if difference is None else linearisation.whiten(difference)
    return choose(linearisation.spectrum, rule, whitened_data, model.mesh)


def compare_rules(
    model: ForwardModel,
    conductivity: ArrayLike,
    *,
    difference: Float[Array, " M"],
    prior: AbstractPrior | None = None,
    noise: Float[Array, " M"] | float = 1.0,
    mask: Bool[Array, " M"] | None = None,
    rules: Mapping[str, Rule] | None = None,
    progress: Callable[[str], None] | None = None,
) -> dict[str, Choice]:
    """Choose λ for the same data by several rules, and return the choices by the name of the rule. The
    eigendecomposition of the problem is computed only once. `jeit.plot.plot_choice` plots the result.

    **Arguments:**

    - `model`: the forward model.
    - `conductivity`: the background, S/m (2-D: S).
    - `difference`, `prior`, `noise`, `mask`: as in `one_step`.
    - `rules`: rules to compare, by name; default `jeit.inverse.RULES`.
    - `progress`: function that is called with the name of each step or rule when it begins.

    Raises `ValueError` for invalid or inconsistent arguments.

    **Example:**

    ```python
    choices = compare_rules(model, 1.0, difference=change, noise=1e-6)
    {name: choice.hyperparameter for name, choice in choices.items()}
    ```
    """
    rules, report_progress = RULES if rules is None else rules, progress or (lambda progress_message: None)
    report_progress("linearise")
    linearisation = Linearisation.create(model, conductivity, prior=prior, noise=noise, mask=mask)
    whitened_data = linearisation.whiten(difference)
    choice_by_rule = {}
    for name, choose_by_rule in rules.items():
        report_progress(name)
        choice_by_rule[name] = choose(linearisation.spectrum, choose_by_rule, whitened_data, model.mesh)
    return choice_by_rule

"""Every setting of every command, given wrongly, ends in one sentence before anything is loaded."""

import mistakes
import pytest

from nlos_lit.runtime.keys import KEYS


@pytest.mark.parametrize("command", KEYS)
def test_no_mistake_is_taken(command):
    given = list(mistakes.mistakes(command))
    assert len(given) > 100
    came = {argument: mistakes.outcome(command, argument) for argument in given}
    assert {argument: how for argument, how in came.items() if how[0] != "refused"} == {}


@pytest.mark.parametrize("command", KEYS)
def test_no_key_lacks_a_range(command):
    """Numbers have two ends (seeds and counts of things at least one), words their list."""
    free = {"a text", "a file or folder that is there", "a name without slashes", "true or false"}
    for key, rule in KEYS[command].items():
        said = str(rule).removesuffix(", or null")
        if "number" in said:
            assert " from " in said or " above " in said, key
            words = () if "a text" in said else ("x" * 9,)  # "bf16-mixed": Lightning checks those
            assert all(rule.problem(value) for value in (float("nan"), -1e300, *words)), key
        elif said not in free and not key.startswith("trainer."):  # Lightning checks those
            assert said.startswith(("one of ", "KEY: VALUE", "a size such as", "a list, each "))

"""How a command ends where it cannot go on."""

import pytest

from nlos_lit.capture.errors import UserError
from nlos_lit.runtime.command_line import sentence_errors


@pytest.mark.parametrize(
    ("raised", "status", "said"),
    [
        (UserError("nothing is there"), 2, "error: nothing is there\n"),
        (KeyboardInterrupt(), 130, "interrupted\n"),
    ],
)
def test_a_command_ends_with_a_sentence(raised, status, said, capsys):
    @sentence_errors
    def command() -> None:
        raise raised

    with pytest.raises(SystemExit) as end:
        command()
    assert end.value.code == status
    assert capsys.readouterr().err == said


def test_a_mistake_of_ours_keeps_its_traceback():
    @sentence_errors
    def command() -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        command()

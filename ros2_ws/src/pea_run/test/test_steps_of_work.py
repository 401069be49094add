"""Work whose results are kept: what cannot be used is named."""

import pytest

from pea_core.params import ParameterError
from pea_run.steps_of_work import STATE, Steps

WHAT = {"kind": "commission", "trials": 4}


def test_a_step_is_done_once_and_found_again(tmp_path):
    steps = Steps(tmp_path / "there", WHAT)
    assert steps.done("identify") is None
    steps.keep("identify", {"K": 0.14})
    assert Steps(tmp_path / "there", WHAT).done("identify") == {"K": 0.14}
    with pytest.raises(FileExistsError):
        steps.keep("identify", {"K": 0.15})


def test_a_result_of_another_version_is_named(tmp_path):
    steps = Steps(tmp_path / "there", WHAT)
    steps.keep("identify", {"K": 0.14})
    found = steps.done("identify")
    with pytest.raises(ParameterError, match=r"identify\.json: has no 'spread', .* remove it"):
        found["spread"]
    assert found.get("spread") is None


@pytest.mark.parametrize("text", ["[1, 2]", "{", "3"])
def test_a_file_that_holds_no_result_is_refused(tmp_path, text):
    steps = Steps(tmp_path / "there", WHAT)
    (tmp_path / "there" / "identify.json").write_text(text)
    with pytest.raises(ParameterError, match=r"identify\.json: is no JSON object; remove it"):
        steps.done("identify")
    (tmp_path / "there" / STATE).write_text(text)
    with pytest.raises(ParameterError, match="holds no work to resume"):
        Steps(tmp_path / "there", WHAT)

"""YAML is read as defined in version 1.2, and ambiguous values are refused."""

from __future__ import annotations

from typing import Any

import pytest
import yaml
from hypothesis import example, given
from hypothesis import strategies as st

from proto.strict_yaml import dump_yaml, load_yaml


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("010", 10),
        ("0o10", 8),
        ("0x1F", 31),
        ("-3", -3),
        ("1e-3", 0.001),
        (".5", 0.5),
        ("-.inf", float("-inf")),
        ("true", True),
        ("", None),
        ("~", None),
        ("yes", "yes"),
        ("off", "off"),
        ("12:30:45", "12:30:45"),
        ("2001-01-01", "2001-01-01"),
        ("1_000", "1_000"),
        ("'5'", "5"),
        ("[1, on]", [1, "on"]),
    ],
)
def test_values(text: str, value: Any) -> None:
    read = load_yaml(text)
    assert read == value
    assert isinstance(read, type(value))


LAUGHS = "a0: &a0 [x, x]\n" + "\n".join(f"a{n}: &a{n} [*a{n - 1}, *a{n - 1}]" for n in range(1, 20))


def test_aliases_are_read_as_what_they_stand_for() -> None:
    assert load_yaml("a: &x [1, 2]\nb: *x\nc: [*x, *x]") == {
        "a": [1, 2],
        "b": [1, 2],
        "c": [[1, 2], [1, 2]],
    }


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: 1\nb: 2\na: 3", "'a' stands twice in the same section, in line 1 and in line 3"),
        ("x:\n  - {a: 1, a: 2}", "in line 2 and in line 2"),
        ("[1]: 2", "line 1: a key must be a name"),
        ("a: !!int x", "'x' is not an integer"),
        ("a: !!bool x", "'x' is not true or false"),
        ("a: !!python/name:os.system", "could not determine a constructor"),
        ("[" * 5000, "nested deeper than 50"),
    ],
)
def test_invalid_yaml_is_refused(text: str, said: str) -> None:
    with pytest.raises(yaml.YAMLError, match=said):
        load_yaml(text)


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
        lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    )
)
@example("0E0")
@example({"1e3": "0o7"})
def test_dumped_yaml_is_read_back_unchanged(value: Any) -> None:
    text = dump_yaml(value)
    assert load_yaml(text) == value
    assert yaml.safe_load(text) == value, "YAML 1.1 reads the same"

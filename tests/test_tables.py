"""Tables as text: Markdown, columns, and methods against figures of merit."""

import numpy as np
import pytest

from pcm_jax.errors import InputError
from pcm_jax.tables import (
    ShownAsTable,
    columns_of_text,
    comparison_table,
    html_table,
    is_number,
    markdown,
)

ROWS = {
    "no-outliers": {"tpr": 1, "fpr": 0.0, "mse": 0.2756, "solver": "converged"},
    "scgp": {"tpr": 0.668, "fpr": 0.0514, "mse": 623.4, "solver": "converged"},
    "dcs": {"tpr": 0, "fpr": 0, "mse": 183_078.4, "solver": "stopped"},
    "pcm": {"tpr": 0.9996, "fpr": 0.00004, "mse": np.nan},
}


def test_markdown_plain_and_aligned():
    rows = [["a - b", 115], ["c", 2]]
    assert markdown(["robots", "n"], rows, numeric=[False, True]).splitlines() == [
        "| robots | n |",
        "| --- | ---: |",
        "| a - b | 115 |",
        "| c | 2 |",
    ]
    assert markdown(["robots", "n"], rows, aligned=True).splitlines() == [
        "| robots | n   |",
        "| ------ | --- |",
        "| a - b  | 115 |",
        "| c      | 2   |",
    ]


def test_columns_of_text_put_numbers_to_the_right():
    assert columns_of_text(["name", "n"], [["x", 5], ["longer", 12.5]]) == (
        "name       n\nx          5\nlonger  12.5"
    )


def test_numbers_are_told_from_words():
    assert [is_number(text) for text in ("1", "-2e3", "nan", "1 m", "")] == [True] * 3 + [False] * 2


def test_a_table_in_markdown():
    text = comparison_table(
        ROWS,
        {"tpr": "TPR", "fpr": "FPR", "mse": "MSE (m²)", "solver": "solver"},
        best={"tpr": max, "fpr": min},
        reference="no-outliers",
    )
    assert text.splitlines() == [
        "|   | TPR | FPR | MSE (m²) | solver |",
        "| --- | ---: | ---: | ---: | --- |",
        "| no-outliers | 1 | 0 | 0.276 | converged |",
        "| scgp | 0.668 | 0.0514 | 623 | converged |",
        "| dcs | 0 | **0** | 183,078 | stopped |",
        "| pcm | **1.00** | 4.00e-05 | – | – |",
    ]


def test_columns_can_be_chosen_and_default_to_all():
    head = comparison_table(ROWS).splitlines()[0]
    assert head == "|   | tpr | fpr | mse | solver |"
    assert comparison_table(ROWS, ["mse"]).splitlines()[3] == "| scgp | 623 |"
    with pytest.raises(InputError, match="columns: 'fnr'"):
        comparison_table(ROWS, ["fnr"])
    with pytest.raises(InputError, match="best: 'fnr'"):
        comparison_table(ROWS, best={"fnr": min})


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1234.5, "1,234"),
        (999.96, "1,000"),
        (9.996, "10.0"),
        (0.09996, "0.100"),
        (-0.0314159, "-0.0314"),
        (0.001, "0.00100"),
        (True, "1"),
        (np.inf, "inf"),
        (None, "–"),
        ("paper", "paper"),
    ],
)
def test_numbers_have_three_digits(value, text):
    assert comparison_table({"method": {"column": value}}).splitlines()[2] == f"| method | {text} |"


def test_html_escapes_and_sets_numbers_to_the_right():
    table = html_table(["robots", "p <"], [["a & <b>", "0.01"]])
    assert '<th scope="col">p &lt;</th>' in table
    assert '<td style="text-align: left">a &amp; &lt;b&gt;</td>' in table
    assert '<td style="text-align: right">0.01</td>' in table


def test_a_result_shows_itself_as_its_repr_above_its_table():
    class Shown(ShownAsTable):
        def __repr__(self):
            return "Shown(<1>)"

        def _table(self):
            return ["n"], [[2]]

    assert Shown()._repr_html_() == f"<pre>Shown(&lt;1&gt;)</pre>{html_table(['n'], [[2]])}"

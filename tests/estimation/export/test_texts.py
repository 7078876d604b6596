"""The transformations of code that is exported."""

import pytest
from export_figures.operations import apart, in_line

from pinnobs_gym.estimation.export.pruning import needed_code
from pinnobs_gym.estimation.export.scalar import scalar, single


@pytest.mark.parametrize(
    ("lanes", "expected"),
    [
        ("EACH_LANE x[i][l] += y[l] * 2.0;", "x[i] += y[0] * 2.0;"),
        ("lanes t, y[NY], k[4][NX];", "real t[1], y[NY], k[4][NX];"),
        ("const lanes *restrict x, lanes *restrict P", "const real *restrict x, real *restrict P"),
        ("lanes *const y = s->y, *const e = s->e;", "real *const y = s->y, *const e = s->e;"),
        ("double sum[W];", "real sum[1];"),
        ("AT_WIDTH(product)(NX, NX, NX, F, P, FP);", "product(NX, NX, NX, F, P, FP);"),
        ("#define sample AT_WIDTH(sample)\nstruct sample s;", "struct sample s;"),
        ("typedef double seconds;", "typedef double seconds;"),
    ],
)
def test_lanes_become_numbers(lanes, expected):
    assert scalar(lanes) == expected + "\n"


def test_comments_on_many_episodes_are_left_out():
    lines = (
        "/* Lower triangular L with L L^T = P. Lanes without one are marked. */",
        "double f(double a); /* the double of a */",
        "/* What NumPy does in each row */",
    )
    found = scalar("\n".join(lines)).split("\n")
    assert found[:2] == [
        "/* Lower triangular L with L L^T = P. */",
        "real f(real a); /* the double of a */",
    ]
    assert not any(found[2:])


def test_literals_of_single_precision():
    text = "a[2] = 0.5 * b2 + 1e-3 - x1.y + 3;"
    assert single(text) == "a[2] = 0.5f * b2 + 1e-3f - x1.y + 3;"


CODE = """/* Sizes */
#define N 2

/* Used by the next one: other( */
static double used(double a) { return 2 * a; }

/* Not used */
static void other(int n)
{
    used(n);
}

static const int places[3] = {0, 1, 2};

/* Uses the first */
static double middle(double a)
{
    if (a > 0) {
        return used(a);
    }
    return 0;
}

double entry(double a)
{
    return middle(a);
}
"""


def test_functions_that_nothing_needs_are_left_out():
    found = needed_code(CODE)
    assert "other(int" not in found
    assert "Not used" not in found
    assert "places" not in found
    for kept in ("/* Sizes */", "used(double a)", "middle(double a)", "double entry(double a)"):
        assert kept in found


@pytest.mark.parametrize(
    ("line", "count"),
    [
        ("const real s61 = F_0 * P_5 + F_2 * P_11 - F_4 * P_21;", 5),
        ("x[i * NX + 1] += h / 6 * (k[1] + 2 * k[0]);", 5),
        ("const real a = sqrt(b) * -c;", 2),
        ("for (int i = 0; i < NX * NX; i++)", 0),
        ("s->t[0] = over->t0 + k * step; /* a - b */", 2),
    ],
)
def test_operations_of_a_line(line, count):
    assert in_line(line) == count


def test_heads_of_loops_have_lines_of_their_own():
    text = "for (int i = 0; i < f(2); i++) if (a) b += c;\nelse {\n"
    assert apart(text) == "for (int i = 0; i < f(2); i++)\n if (a)\n b += c;\nelse {\n"

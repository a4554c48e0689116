"""The mutation check itself: what it changes, what it leaves alone, and that every change is a program."""

import ast

from tests.deleted import needs
from tests.mutation.mutate import ROOT, accepted_reasons, mutants_of
from tests.mutation.operators import mutants
from tests.mutation.operators_c import c_mutants
from tests.mutation.targets import fast_tests, target_files

SOURCE = '''"""1 + 1"""
LIMIT = 0.5

def f(x: float, n: int = 3) -> float:
    """Sum - difference."""
    if x < 0:
        raise ValueError(f"{x + 1}")
    y = -sin(x[0]) * 2 ** n
    y += max(x[2], "a" + "b")
    return y
'''


def test_signs_constants_comparisons_and_functions():
    found = {mutant.key.split(": ", 1)[1] for mutant in mutants("f.py", SOURCE)}
    assert found == {
        "0.5 => 0.75",
        "x < 0 => (x > 0)",
        "0 => 1",
        "-sin(x[0]) => (sin(x[0]))",
        "-sin(x[0]) * 2 ** n => (-sin(x[0]) / 2 ** n)",
        "sin => cos",
        "0 => 1 #1",
        "2 ** n => (2 * n)",
        "2 => 3",
        "y += max(x[2], \"a\" + \"b\") => y -= max(x[2], 'a' + 'b')",
        "max => min",
        "2 => 1",
    }


def test_signs_constants_and_comparisons_in_c():
    source = "/* 1 + 1 */\n#if X\nenum { L = 8 };\n#endif\nfor (int i = 0; i < N; ++i) y[i] += -2.0 * *(p + 1);\n"
    changed = {mutant.source.splitlines()[-1] for mutant in c_mutants("f.c", source)}
    assert changed == {
        "for (int i = 1; i < N; ++i) y[i] += -2.0 * *(p + 1);",
        "for (int i = 0; i > N; ++i) y[i] += -2.0 * *(p + 1);",
        "for (int i = 0; i < N; ++i) y[i] -= -2.0 * *(p + 1);",
        "for (int i = 0; i < N; ++i) y[i] += -3.0 * *(p + 1);",
        "for (int i = 0; i < N; ++i) y[i] += -2.0 / *(p + 1);",
        "for (int i = 0; i < N; ++i) y[i] += -2.0 * *(p - 1);",
        "for (int i = 0; i < N; ++i) y[i] += -2.0 * *(p + 2);",
    }


@needs()
def test_mutants_of_the_package_are_other_programs_and_have_tests():
    keys = []
    for file in target_files(ROOT):
        source = (ROOT / file).read_text()
        assert fast_tests(file, ROOT)
        of_file = mutants_of(file)
        keys += [mutant.key for mutant in of_file]
        for mutant in of_file[::20]:
            assert mutant.source != source
            if file.endswith(".py"):
                assert ast.dump(ast.parse(mutant.source)) != ast.dump(ast.parse(source)), mutant.key
    assert len(keys) > 1000 and len(set(keys)) == len(keys)
    assert all(reason for reason in accepted_reasons().values())
    assert not set(accepted_reasons()) - set(keys), "accepted, but no mutant any more"

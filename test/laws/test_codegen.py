# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Programs: expressions, both back ends, the sparse factors, and the cache of compiled code."""

import hashlib
import json
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from pkm_twin import variants
from pkm_twin.codegen import cache
from pkm_twin.codegen import code as codes
from pkm_twin.codegen import expressions as ex
from pkm_twin.codegen import operations as op
from pkm_twin.codegen.cholesky import MIN_PIVOT_RATIO, trace_over
from pkm_twin.codegen.code import Code
from pkm_twin.codegen.expressions import tangents
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.codegen.key import ProgramKey
from pkm_twin.codegen.lu import SparseLU, independent_rows, pivot_order
from pkm_twin.codegen.program import Program
from pkm_twin.errors import ParameterError, UnreachableError
from test.support.bodies import PlainKernel
from test.support.robots import every_robot, load, random_joints

NONE = np.zeros(0)
compiled = pytest.mark.skipif(not codes.compiled(), reason="no compiler here")


def program(write, size):
    """A program of one input x of that size."""
    tape = ex.Tape()
    results = write(tape.inputs("x", size))
    return Program({"x": size}, 0, {"y": [tape.lift(r) for r in results]})


def both(write, x, key):
    """What compiled and plain code give for samples x, shape (count, size)."""
    made = program(write, x.shape[1])
    (fast,), status = Kernel(Code(lambda: made, ProgramKey(key)))(NONE, x)
    assert status is None
    (slow,), codes = PlainKernel(made).run([x])
    assert not codes[:, 0].any()
    return fast, slow


def formula(x):
    a, b, c, d = x
    s = op.sqrt(a * a + b * b + 1.0)
    return [
        a + b,
        a - b,
        a * b,
        -a,
        a / s,
        s,
        op.sin(a),
        op.cos(b),
        op.absolute(c),
        op.sign(d),
        op.atan2(a, b),
        op.minimum(a, c),
        op.maximum(b, d),
        (a + b) * (a - b) - c / s + 3.0 * d,
        op.exp(a),
        op.tanh(b),
        op.less(a, b),
        op.select(op.less(c, d), a, -b),
        op.select(c, a, d),
        op.sin(a) * op.cos(a) - (-b) * (-c),
        2.0 - (3.0 - a),
        (a - b) - (b - a),
        0.0 * a + 1.0 * b,
    ]


def test_expressions_are_numpys_numbers(rng):
    """The same formula on expressions, compiled and plain, and on arrays of floats."""
    x = rng.normal(size=(501, 4))
    x[0] = 0.0
    expected = np.stack(np.broadcast_arrays(*formula(x.T)), -1)
    fast, slow = both(formula, x, "test formula")
    np.testing.assert_allclose(fast, expected, rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(slow, expected, rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(fast, slow, rtol=1e-13, atol=1e-13)


def test_equal_expressions_are_one_and_constants_fold():
    tape = ex.Tape()
    a, b = tape.inputs("x", 2)
    assert a + b is b + a
    assert op.sin(a) is op.sin(a)
    assert (a * 0.0).is_constant(0.0)
    assert a * 1.0 is a
    assert a - a is tape.constant(0.0)
    assert 0.0 - (-a) is a
    assert op.sqrt(tape.constant(4.0)).is_constant(2.0)
    # The sign of zero is another number to atan2.
    assert tape.constant(0.0) is not tape.constant(-0.0)


@compiled
def test_constants_keep_their_bits():
    values = np.tile([0.0, -0.0, 5e-324, 1.7e299, 1 / 3, -1 / 3], (5, 1))
    for found in both(lambda x: values[0].tolist(), np.zeros((5, 1)), "test constants"):
        assert found.tobytes() == values.tobytes()


@compiled
def test_sine_cosine_and_arctangent_over_large_ranges(rng):
    """Within an ulp or two of numpy's, from tiny to a million turns, and in every quadrant."""
    size = np.concatenate([10.0 ** rng.uniform(-300, -3, 500), 10.0 ** rng.uniform(-3, 6, 4000)])
    a = size * rng.choice([-1.0, 1.0], len(size))
    near = np.pi / 2 * rng.integers(-1000, 1000, 1000) + rng.normal(0.0, 1e-9, 1000)
    a = np.concatenate([a, near, [0.0]])[:, None]
    fast, _ = both(lambda x: [op.sin(x[0]), op.cos(x[0])], a, "test sincos")
    # The reduction has three parts of pi / 2: what they miss grows with the turns.
    bound = 4e-16 + 5e-21 * np.abs(a[:, 0])
    assert (np.abs(fast[:, 0] - np.sin(a[:, 0])) <= bound).all()
    assert (np.abs(fast[:, 1] - np.cos(a[:, 0])) <= bound).all()
    small = np.abs(a[:, 0]) < 1e-3
    np.testing.assert_allclose(fast[small, 0], np.sin(a[small, 0]), rtol=4e-16)
    # Beyond, the reduction would lose digits.
    far = np.array([1e6, -1e6, 1e9, 1e16, 1e300, -1e308])[:, None]
    tape = program(lambda x: [op.sin(x[0]), op.cos(x[0])], 1)
    (fast,), _ = Kernel(Code(lambda: tape, ProgramKey("test sincos")))(NONE, far)
    (slow,), _ = PlainKernel(tape).run([far])
    assert np.isnan(fast).all() and np.isnan(slow).all()
    pairs = 10.0 ** rng.uniform(-100, 100, (4000, 2)) * rng.choice([-1.0, 1.0], (4000, 2))
    pairs[:2000] = rng.normal(size=(2000, 2))
    special = [[0.0, 1.0], [0.0, -1.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 0.0], [1.0, 1.0]]
    pairs = np.concatenate([pairs, special])
    fast, _ = both(lambda x: [op.atan2(x[0], x[1])], pairs, "test atan2")
    np.testing.assert_allclose(fast[:, 0], np.arctan2(*pairs.T), rtol=5e-16, atol=1e-300)


@compiled
def test_exponential_and_hyperbolic_tangent_over_their_whole_range(rng):
    """Within two ulps of numpy's, to where they are zero, one or infinite."""
    x = np.concatenate([rng.uniform(-745.0, 690.0, 4000), 10.0 ** rng.uniform(-300, 1, 1000), [0]])
    x = np.concatenate([x, -x[4000:]])[:, None]
    fast, slow = both(lambda x: [op.exp(x[0]), op.tanh(x[0])], x, "test exponential")
    for found in (fast, slow):
        np.testing.assert_allclose(found[:, 0], np.exp(x[:, 0]), rtol=5e-16, atol=1e-323)
        np.testing.assert_allclose(found[:, 1], np.tanh(x[:, 0]), rtol=5e-16)
    # An infinite value is refused, its reciprocal is zero.
    far = np.array([[720.0], [1e4], [1e290]])
    for found in both(lambda x: [1.0 / op.exp(x[0]), op.exp(-x[0])], far, "test infinite"):
        np.testing.assert_allclose(found[:, 0], found[:, 1], rtol=1e-9, atol=1e-300)
        assert (found[1:] == 0.0).all()


@pytest.mark.parametrize("name", [one.name for one in op.OPERATIONS])
def test_slopes_of_operations_are_those_of_their_values(rng, name):
    """Central differences, away from where an operation jumps."""
    (one,) = (one for one in op.OPERATIONS if one.name == name)
    values = rng.uniform(0.5, 1.5, 3)
    arguments = 3 if name == "select" else 1
    if name in {"add", "sub", "mul", "atan2", "min", "max", "less"}:
        arguments = 2
    tape = ex.Tape(values.tolist())
    given = list(tape.inputs(ex.GEOMETRY, 3))[:arguments]
    (found,) = tangents([one(*given)], given)
    assert tangents([one(*given)], given, at_reference=True) == [[ex.reference(slope) for slope in found]]
    for k, slope in enumerate(found):
        step = 1e-6 * np.eye(3)[k]
        high, low = (one.numbers(*(values + s)[:arguments]) for s in (step, -step))
        assert ex.reference(slope) == pytest.approx((high - low) / 2e-6, abs=1e-8)


@every_robot
def test_both_back_ends_agree_and_one_sample_has_the_bits_of_its_batch(name, rng):
    robot = load(name)
    q = random_joints(robot, rng, 9)
    for kernel in (robot.engine.forward, robot.engine.jacobian):
        outputs, status = kernel(NONE, q)
        assert status is None
        slow, codes = PlainKernel(kernel.program, kernel.geometry).run([q], 4)
        good = codes[:, 0] == 0.0
        assert good.any()
        for fast, plain in zip(outputs, slow, strict=True):
            size = max(1.0, np.abs(fast).max())
            np.testing.assert_allclose(fast[good], plain[good], rtol=1e-13, atol=1e-13 * size)
        for k in range(len(q)):
            single, _ = kernel(NONE, q[k].copy())
            for fast, one in zip(outputs, single, strict=True):
                np.testing.assert_array_equal(one, fast[k])


@compiled
def test_large_batches_in_threads_have_the_same_bits(rng, monkeypatch):
    """Of one machine and of many, with samples that are refused."""
    robot = load("prru")
    q = random_joints(robot, rng, 3 * codes.MIN_SAMPLES_PER_THREAD + 7)
    motion = (q, *rng.normal(size=(2, *q.shape)))
    few = tuple(array[:101].copy() for array in motion)
    few[0][5, 0] = 40.0
    out_of_reach = np.concatenate((q, few[0]))
    many = variants(robot, {"geometry.limb_length": rng.uniform(0.5, 0.7, 3 * codes.MIN_SAMPLES_PER_THREAD // 50)})

    def answers():
        with pytest.raises(UnreachableError) as refused:
            robot.forward(out_of_reach)
        assert refused.value.index == (len(q) + 5,)
        return inverse_dynamics(robot, *motion), many.inverse_dynamics(*few)

    alone, used = answers(), []
    monkeypatch.setattr(codes, "read_thread_count", lambda: used.append(3) or 3)
    for one, other in zip(alone, answers(), strict=True):
        np.testing.assert_array_equal(one, other)
    assert len(used) >= 3
    assert np.isnan(alone[1][:, 5]).all()


@compiled
def test_a_call_keeps_its_arguments_while_other_threads_allocate(monkeypatch):
    """Compiled code reads where and how many its samples are after the interpreter's lock."""
    code = Code(lambda: program(lambda x: [2.0 * x[0]], 1), ProgramKey("test arguments"))
    header, prepare, batch, one = code._loaded
    taken = []

    def interrupted(address):
        taken.extend(np.zeros(k, np.int64) for k in range(1, 40))
        return batch(address)

    monkeypatch.setitem(code.__dict__, "_loaded", (header, prepare, interrupted, one))
    x = np.arange(codes.MAX_BUFFERED_SAMPLES + 5.0)[:, None]
    (y,), status = Kernel(code)(NONE, x)
    assert status is None and len(taken) > 0
    np.testing.assert_array_equal(y, 2.0 * x)


def test_a_number_of_threads_is_a_number(monkeypatch):
    monkeypatch.delenv(codes.THREADS_VARIABLE, raising=False)
    assert codes.read_thread_count() == 1
    for text, number in (("", 1), ("3", 3), ("0", len(os.sched_getaffinity(0)))):
        monkeypatch.setenv(codes.THREADS_VARIABLE, text)
        assert codes.read_thread_count() == number
    for text in ("two", "-1", "1.5", "²"):
        monkeypatch.setenv(codes.THREADS_VARIABLE, text)
        with pytest.raises(ParameterError):
            codes.read_thread_count()


@pytest.mark.parametrize("size", [1, 2, 5, 12])
def test_sparse_factors_solve_as_numpy_does(size, rng):
    for _ in range(5):
        full = rng.normal(size=(size, size)) * (rng.random((size, size)) < 0.5)
        full += np.eye(size)[rng.permutation(size)] * 3.0
        right = rng.normal(size=size)
        objects = full.astype(object)
        lu = SparseLU(objects, pivot_order(full[None]))
        np.testing.assert_allclose(lu.solve(right).astype(float), np.linalg.solve(full, right), rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(
            lu.solve_transposed(right).astype(float),
            np.linalg.solve(full.T, right),
            rtol=1e-9,
            atol=1e-10,
        )
        assert float(lu.inverse_determinant) * np.linalg.det(full) == pytest.approx(1.0, rel=1e-9)


def test_independent_rows_are_a_basis_of_all_rows(rng):
    base = rng.normal(size=(3, 4, 6))
    mixed = np.einsum("ij,kjl->kil", rng.normal(size=(9, 4)), base)
    chosen = independent_rows(mixed)
    assert len(chosen) == 4
    assert (np.linalg.matrix_rank(mixed[:, chosen]) == 4).all()
    mixed[1] = 0.0
    with np.errstate(all="raise"):
        assert independent_rows(mixed) == []


PROGRAM = """
import logging, sys
logging.basicConfig(level=logging.WARNING, format="%(message)s")
from pkm_twin import load
robot = load("delta")
print(robot.forward([0.1, 0.2, 0.3]).tolist(), robot.jacobian([0.1, 0.2, 0.3]).tolist())
"""


COUNTED = """
import atexit
from pkm_twin.codegen import native
compile_object, calls = native.compile_object, []
native.compile_object = lambda *a: (calls.append(0), compile_object(*a))[1]
atexit.register(lambda: print(len(calls)))
"""


def start(folder, program=PROGRAM):
    environment = {k: v for k, v in os.environ.items() if k != "_ROS_WHEELS_BOOTSTRAP_COMPLETE"}
    environment |= {"PKM_TWIN_CACHE": str(folder), "PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.Popen(
        [sys.executable, "-c", program],
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def run_to_end(process):
    out, error = process.communicate()
    assert process.returncode == 0, error
    return out, error.splitlines()


@compiled
def test_sources_that_emit_the_same_text_share_a_program(tmp_path, monkeypatch):
    """A changed source is traced again; only another text is compiled."""
    from pkm_twin.codegen import native

    monkeypatch.setenv("PKM_TWIN_CACHE", str(tmp_path))
    compiled_texts = []
    compile_object = native.compile_object

    def counted(text, level):
        compiled_texts.append(text)
        return compile_object(text, level)

    monkeypatch.setattr(native, "compile_object", counted)

    def result(key, factor):
        built = []

        def build():
            built.append(key)
            return program(lambda x: [factor * x[0]], 1)

        return Kernel(Code(build, ProgramKey(key)))(NONE, [1.0])[0][0][0], len(built)

    assert result("before", 2.0) == (2.0, 1)
    assert result("before", 2.0) == (2.0, 0)
    assert result("an edit of a comment", 2.0) == (2.0, 1)
    assert result("an edit of a comment", 2.0) == (2.0, 0)
    assert len(compiled_texts) == 1
    assert result("an edit of a factor", 3.0) == (3.0, 1)
    assert len(compiled_texts) == 2


@compiled
def test_processes_that_start_cold_compile_each_program_once(tmp_path):
    """And without a folder each for itself, with a warning: the same numbers every time."""
    folder, blocked = tmp_path / "cache", tmp_path / "file"
    blocked.write_text("no folder")
    counted = COUNTED + PROGRAM
    ended = [run_to_end(p) for p in [start(folder, counted) for _ in range(4)]]
    assert not any(warnings for _, warnings in ended)
    outputs = [out.splitlines() for out, _ in ended]
    # Two programs and two names of what their sources emit; no lock.
    assert sum(int(lines[-1]) for lines in outputs) == len(list(folder.iterdir())) // 2 == 2
    out, (line,) = run_to_end(start(blocked))
    assert {tuple(lines[:-1]) for lines in outputs} == {tuple(out.splitlines())}
    assert "compiled programs are not kept" in line


def test_a_lock_that_is_not_released_delays_and_does_not_block(tmp_path, monkeypatch):
    monkeypatch.setenv("PKM_TWIN_CACHE", str(tmp_path))
    monkeypatch.setattr(cache, "LOCK_TIMEOUT", 0.05)
    entered = []
    with cache.lock_program("0" * 32), cache.lock_program("0" * 32):
        entered.append("both")
    (tmp_path / f"{'1' * 32}.lock").mkdir()
    with cache.lock_program("1" * 32):
        entered.append("without")
    assert entered == ["both", "without"]


@compiled
def test_the_cache_has_a_limit(tmp_path, monkeypatch):
    """Programs that were not used for the longest time go first."""
    monkeypatch.setenv("PKM_TWIN_CACHE", str(tmp_path))
    code = bytes(1000)
    monkeypatch.setattr(cache, "MAX_BYTES", 12 * 1200)
    names = [f"{k:064x}" for k in range(30)]
    for k, name in enumerate(names):
        cache.write(name, {}, code)
        os.utime(tmp_path / name, ns=(k, k))
        # Used again and again: the newest, whenever it was written.
        assert cache.read(names[0]) == ({}, code)
    left = sorted(path.name for path in tmp_path.iterdir())
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) <= cache.MAX_BYTES
    assert names[0] in left and names[-1] in left and names[1] not in left


def other_name(path, other):
    """A sound program of another kernel, copied to this one's place."""
    shutil.copy(other, path)


def other_mode(path, _):
    path.chmod(0o622)


def other_owner(path, _):
    if os.geteuid() == 0:
        os.chown(path, 12345, -1)


def fifo(path, _):
    """Nobody writes into it."""
    path.unlink()
    os.mkfifo(path)


def device(path, _):
    """It never ends."""
    path.unlink()
    path.symlink_to("/dev/zero")


def content(change):
    """A stored program, changed and not sealed."""
    return lambda path, _: path.write_bytes(change(path.read_bytes()))


def sealed(change):
    """A stored program, changed and then sealed again."""

    def harm(path, _):
        mark, body = path.read_bytes().split(b"\n", 1)
        head, code = body[32:].split(b"\n", 1)
        head, code = change(json.loads(head), code)
        body = head + b"\n" + code
        path.write_bytes(mark + b"\n" + hashlib.sha256(body).digest() + body)

    return harm


def with_header(**values):
    return sealed(lambda head, code: (json.dumps({**head, **values}).encode(), code))


def with_code(change):
    return sealed(lambda head, code: (json.dumps(head).encode(), change(code)))


HARM = [
    other_name,
    other_mode,
    other_owner,
    fifo,
    device,
    content(lambda whole: whole[:-1] + b"\1"),
    content(lambda whole: b""),
    content(lambda whole: whole[:100]),
    content(lambda whole: bytes(len(whole))),
    sealed(lambda _, code: (b"{", code)),
    sealed(lambda _, code: (b"[" * 100_000, code)),
    sealed(lambda _, code: (b"[]", code)),
    sealed(lambda _, code: (b"{}", code)),
    with_header(inputs=[1e3]),
    with_header(outputs=3),
    with_header(outputs=[-1]),
    with_header(parameters=10**12),
    with_header(stepped=None),
    with_code(lambda code: b""),
    with_code(lambda code: b"kernel" * 1000),
    with_code(lambda code: code[: len(code) // 2]),
    with_code(lambda code: code[:64] + bytes(max(len(code) - 64, 0))),
    with_code(lambda code: code.replace(b"kernel", b"colonel"[:6])),
]


@compiled
@pytest.mark.parametrize("level", ["name", "program"])
@pytest.mark.parametrize("harm", HARM)
def test_a_stored_program_that_must_not_run_is_rebuilt(tmp_path, monkeypatch, harm, level):
    monkeypatch.setenv("PKM_TWIN_CACHE", str(tmp_path))
    made = [program(lambda x, k=k: [k * x[0]], 1) for k in (2.0, 3.0)]

    def outputs():
        codes = [Code(lambda m=m: m, ProgramKey(f"times {k}")) for k, m in enumerate(made)]
        return [Kernel(code)(NONE, [1.0])[0][0][0] for code in codes]

    assert outputs() == [2.0, 3.0]
    paths = sorted(tmp_path.iterdir(), key=lambda path: (path.stat().st_size, path.name))
    whole = [path.read_bytes() for path in paths]
    # The names of what sources emit, then the programs.
    harm(*(paths[:2] if level == "name" else paths[2:]))
    assert outputs() == [2.0, 3.0]
    assert [path.read_bytes() for path in paths] == whole
    assert {(path.stat().st_mode & 0o777, path.stat().st_uid) for path in paths} == {(0o600, os.geteuid())}


def test_trace_over_sparse_matrices(rng):
    """On numbers and compiled; the numerator's pattern is another than the matrix'."""
    for size in (1, 2, 5, 9):
        sparse = rng.uniform(size=(2, 2 * size, size)) < 0.4
        a, b = rng.normal(size=(2, 2 * size, size)) * sparse + np.eye(2 * size, size)
        matrix, numerator = a.T @ a, b.T @ b
        expected = np.trace(np.linalg.solve(matrix, numerator))
        assert trace_over(numerator, matrix) == pytest.approx(expected, rel=1e-9)
        flat = np.concatenate([matrix.ravel(), numerator.ravel()])[None]

        def write(x, size=size):
            first, other = np.array(x, dtype=object).reshape(2, size, size)
            return [trace_over(other, first)]

        for found in both(write, flat, f"trace {size}"):
            assert found[0] == pytest.approx([expected], rel=1e-9)


def test_trace_over_a_matrix_without_inverse_is_large_and_finite():
    found = trace_over(np.eye(2), np.ones((2, 2)))
    assert 1e12 < found <= 2.0 / MIN_PIVOT_RATIO

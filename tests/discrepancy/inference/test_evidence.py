"""Likelihood and evidence where both are known in closed form, their calibration, and what must not change them."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from neuido.discrepancy.inference.calibration import Calibration, calibration, quantile
from neuido.discrepancy.inference.evidence import KINDS, LEAST, Evidence, densities, evidences, judged, price, shift_to_prior_mean, unseen
from neuido.discrepancy.inference.journal import FitRecord
from neuido.discrepancy.inference.likelihood import SCALES, log_densities, log_mean, rotated, share
from neuido.discrepancy.inference.search.attribution import diagnose
from neuido.discrepancy.inference.statistics import PartStatistics, best_fits, read
from tests.discrepancy.report.test_answer import Curve

NOISE, ROWS, PHI = 0.3, 40, 0.1
T = np.linspace(0.0, 1.0, ROWS)


def part(rng, *, rows=ROWS, smooth=4, nuisances=2, settings=2, slopes=2):
    """A part of random directions, and of a random residual."""
    S = rng.normal(size=(rows, smooth))
    S /= np.sqrt(np.mean(np.sum(S**2, axis=1))) if smooth else 1.0
    N, D, J = (0.5 * rng.normal(size=(rows, k)) for k in (nuisances, settings, slopes))
    return PartStatistics(rows, NOISE, S, N, D, J, rng.normal(size=rows))


def reduced(p):
    """The same part in a basis of its directions."""
    names = ("smooth", "nuisances", "settings", "slopes")
    whole = np.concatenate([getattr(p, n) for n in names] + [p.residual[:, None]], axis=1)
    basis, _ = np.linalg.qr(whole)
    return replace(p, residual=basis.T @ p.residual, **{n: basis.T @ getattr(p, n) for n in names})


def covariance(parts, variances, scale):
    """Of the residuals of recordings, each a part, one after another."""
    shared = np.concatenate([np.concatenate([p.settings, p.slopes], axis=1) for p in parts])
    out = shared @ np.diag(np.concatenate([np.ones(parts[0].settings.shape[1]), variances])) @ shared.T
    at = 0
    for p in parts:
        own = slice(at, at := at + p.rows)
        out[own, own] += NOISE**2 * np.eye(p.rows) + p.nuisances @ p.nuisances.T + scale**2 * p.smooth @ p.smooth.T
    return out


@pytest.mark.parametrize("basis", [lambda p: p, reduced])
@pytest.mark.parametrize("sizes", [{}, {"settings": 0, "smooth": 0}, {"slopes": 0, "settings": 0}, {"nuisances": 0}])
def test_a_density_is_that_of_the_whole_covariance(basis, sizes):
    rng = np.random.default_rng(3)
    parts, scales = [part(rng, **sizes), part(rng, rows=25, **sizes)], np.array([1e-6, 0.4, 30.0])
    variances = np.array([2.0, 0.3])[: parts[0].slopes.shape[1]]
    made = [rotated([p], [np.concatenate([p.settings, p.slopes], axis=1)]) for p in map(basis, parts)]
    prior = np.concatenate([np.ones(parts[0].settings.shape[1]), variances])
    r = np.concatenate([p.residual for p in parts])
    whole = [multivariate_normal(np.zeros(len(r)), covariance(parts, variances, s)).logpdf(r) for s in scales]
    np.testing.assert_allclose(log_densities(made, prior, scales), whole, rtol=1e-8)


def test_what_is_held_out_is_foretold_by_the_conditional_density():
    rng = np.random.default_rng(5)
    parts, variances = [part(rng, smooth=0) for _ in range(2)], np.array([2.0, 0.3])
    C = covariance(parts, variances, 0.0)
    a, b = (p.residual for p in parts)
    gain = C[ROWS:, :ROWS] @ np.linalg.inv(C[:ROWS, :ROWS])
    known = multivariate_normal(gain @ a, C[ROWS:, ROWS:] - gain @ C[:ROWS, ROWS:]).logpdf(b)
    assert densities(parts, [0, 1], [True, False], variances, 1.0)[0] == pytest.approx(known)


def test_the_last_part_of_a_recording_shares_its_nuisances():
    """A nuisance that the first part has told is known in the second one."""
    rng = np.random.default_rng(6)
    p = part(rng, smooth=0, settings=0, slopes=0, nuisances=1)
    big = replace(p, nuisances=20.0 * np.ones((ROWS, 1)), residual=7.0 + NOISE * rng.normal(size=ROWS))
    one, _ = densities([big, big], [0, 0], [True, False], np.empty(0), 1.0)
    two, _ = densities([big, big], [0, 1], [True, False], np.empty(0), 1.0)
    assert one > two + 2.0


def test_the_scale_is_averaged_from_what_the_settings_leave_upwards():
    """One datum along one pattern, each order of magnitude of the scale alike."""
    phi, e = 0.8, 5.0
    p = PartStatistics(1, NOISE, np.ones((1, 1)), *(np.zeros((1, 0)) for _ in range(3)), np.array([e]))
    found = log_mean(log_densities([rotated([p], [np.zeros((1, 0))])], np.empty(0), SCALES * phi))

    def density(log_scale):
        v = NOISE**2 + math.exp(2.0 * log_scale)
        return math.exp(-0.5 * e**2 / v) / math.sqrt(2.0 * math.pi * v)

    least, most = math.log(phi), math.log(1000.0 * phi)
    assert found == pytest.approx(math.log(quad(density, least, most)[0] / (most - least)), abs=0.02)
    assert SCALES[0] == 1.0  # never below


def test_what_a_setting_leaves_after_a_refit_is_the_scale():
    J, off = np.sin(3 * T)[:, None], np.cos(9 * T)[:, None]
    nothing = np.zeros((ROWS, 0))
    p = PartStatistics(ROWS, NOISE, nothing, nothing, np.concatenate([2.0 * J, 0.0 * J], axis=1), J, T)
    assert unseen([p]) == pytest.approx(LEAST * NOISE)  # slopes make it good; one that did not run counts for nothing
    own = off - J @ np.linalg.lstsq(J, off, rcond=None)[0]
    assert unseen([replace(p, settings=off)]) == pytest.approx(math.sqrt(np.mean(own**2)))
    wide = replace(p, settings=off, slopes=np.concatenate([J, off], axis=1))  # an effect that could imitate the setting
    assert unseen([wide], [True, False]) == pytest.approx(math.sqrt(np.mean(own**2)))
    assert unseen([wide]) == pytest.approx(LEAST * NOISE)


@pytest.fixture(scope="module")
def toys():
    """Draws, patterns, and the slopes of the declared model and of one with each of six candidates, for two recordings."""
    rng = np.random.default_rng(8)
    smooth = np.stack([np.cos(math.pi * k * T) for k in range(5)], axis=1)
    smooth /= np.sqrt(np.mean(np.sum(smooth**2, axis=1)))
    base = T[:, None] - 0.5
    slopes = {(): [base, base]}
    for i in range(6):
        slopes[f"c{i}",] = [np.concatenate([base, np.sin((4 + 3 * i) * T + rng.normal())[:, None]], axis=1) for _ in range(2)]
    return rng, smooth, slopes


def weighed(residuals, slopes, smooth, *, refit=True):
    """The evidence of each model for residuals of two recordings; `refit`: they are taken where a fit of the first one ended."""
    out = []
    for effects, J in slopes.items():
        q = np.linalg.lstsq(J[0], residuals[0], rcond=None)[0] if refit else np.zeros(J[0].shape[1])
        own = [r - j @ q for r, j in zip(residuals, J, strict=True)]
        nothing = np.zeros((ROWS, 0))
        parts = [PartStatistics(ROWS, NOISE, smooth, nothing, nothing, j, r) for j, r in zip(J, own, strict=True)]
        foretold, beyond = densities(shift_to_prior_mean(parts, -q), [0, 1], [True, False], np.full(len(q), 9.0), PHI)
        out.append(of(foretold - price(len(effects), len(slopes) - 1), *effects, beyond=beyond))
    return out


def of(value, *effects, beyond=0.0):
    return Evidence(FitRecord(0, effects, {}, (), 0.0, True, 1, 0, (), ()), value, beyond)


def drawn(rng, smooth, slopes, effect=0.0):
    """Residuals under the declared model and a solver that differs by up to three times as much as the settings do.

    `effect`: size of the first candidate beside it.
    """
    s = PHI * math.exp(rng.uniform(0.0, math.log(3.0)))
    q = np.array([3.0 * rng.normal(), effect])
    return [slopes["c0",][n] @ q + s * smooth @ rng.normal(size=smooth.shape[1]) + NOISE * rng.normal(size=ROWS) for n in range(2)]


def lead_of(found):
    return max(e.value for e in found) - next(e.value for e in found if not e.effects)


@pytest.fixture(scope="module")
def toy_calibration(toys):
    rng, smooth, slopes = toys
    behind: dict[tuple, list[float]] = {(): [], ("c0",): []}
    beyond = []
    for true, own in behind.items():
        for _ in range(25):
            found = weighed(drawn(rng, smooth, slopes, effect=4.0 * len(true)), slopes, smooth)
            model = next(e for e in found if e.effects == true)
            own.append(max(e.value for e in found) - model.value)
            beyond.append(model.beyond)
    return Calibration(*map(tuple, behind.values()), tuple(beyond))


def test_nothing_is_named_on_nulls(toys, toy_calibration):
    rng, smooth, slopes = toys
    found = [weighed(drawn(rng, smooth, slopes), slopes, smooth) for _ in range(40)]
    verdicts = [judged(own, toy_calibration) for own in found]
    assert sum(v.answer in ("effect", "class") for v in verdicts) <= 5  # 5 % on average over such tables
    assert sum(v.answer == "unknown" for v in verdicts) <= 5
    assert sum(lead_of(own) > math.log((KINDS - 1) / 0.05) for own in found) <= 2  # Markov's inequality, as this likelihood is right
    assert 0.4 < np.mean([v.p_value for v in verdicts]) and min(v.p_value for v in verdicts) >= 1 / 26


def test_where_a_fit_ended_does_not_count_where_the_model_is_linear(toys):
    rng, smooth, slopes = toys
    residuals = drawn(rng, smooth, slopes, effect=2.0)
    refitted, plain = (weighed(residuals, slopes, smooth, refit=refit) for refit in (True, False))
    np.testing.assert_allclose([e.value for e in refitted], [e.value for e in plain], rtol=1e-8)


def test_an_effect_is_named(toys, toy_calibration):
    rng, smooth, slopes = toys
    verdicts = [judged(weighed(drawn(rng, smooth, slopes, effect=4.0), slopes, smooth), toy_calibration) for _ in range(20)]
    assert sum(v.answer in ("effect", "class") and ("c0",) in v.sets for v in verdicts) >= 18


def test_what_no_effect_explains_is_unknown(toys, toy_calibration):
    rng, smooth, slopes = toys
    answers = []
    for _ in range(10):
        residuals = [own + 40.0 * smooth @ rng.normal(size=smooth.shape[1]) for own in drawn(rng, smooth, slopes)]
        answers.append(judged(weighed(residuals, slopes, smooth), toy_calibration).answer)
    assert answers.count("unknown") == 10


def test_a_solver_that_differs_by_less_than_the_settings_is_not_unknown():
    """With the suggested solver itself no pattern is left, however much the settings differ by."""
    rng = np.random.default_rng(10)
    exact = [replace(part(rng, rows=400, slopes=0, settings=0, nuisances=0), residual=NOISE * rng.normal(size=400)) for _ in range(2)]
    _, beyond = densities(exact, [0, 1], [True, False], np.empty(0), 20.0 * NOISE)
    assert beyond < 0.0


def test_no_set_leads_by_fitting_what_settings_differ_by():
    """What is left lies within what the settings leave of one another: half of it taken away is worth next to nothing."""
    rng = np.random.default_rng(12)
    smooth = np.stack([np.cos(math.pi * k * np.linspace(0.0, 1.0, 400)) for k in range(5)], axis=1)
    smooth /= np.sqrt(np.mean(np.sum(smooth**2, axis=1)))
    nothing, phi = np.zeros((400, 0)), 10.0 * NOISE
    own = [smooth @ rng.normal(size=5) for _ in range(2)]
    noise = NOISE * rng.normal(size=(2, 400))

    def value(left):
        parts = [PartStatistics(400, NOISE, smooth, nothing, nothing, nothing, left * phi * o + n) for o, n in zip(own, noise, strict=True)]
        return densities(parts, [0, 1], [True, False], np.empty(0), phi)[0]

    assert value(0.25) - value(0.5) < 2.0
    assert value(2.0) - value(20.0) > 10.0


@pytest.mark.parametrize("rows", [400, 40_000])
def test_more_points_outside_the_patterns_do_not_say_more(rows):
    """A difference of solvers that is finer than the patterns, of 0.3 of the noise, of which an effect happens to take a tenth."""
    rng = np.random.default_rng(11)
    t, nothing = np.linspace(0.0, 1.0, rows), np.zeros((rows, 0))
    smooth = np.stack([np.cos(math.pi * k * t) for k in range(5)], axis=1)
    fine = 0.3 * NOISE * math.sqrt(2.0) * np.cos(40.0 * math.pi * t)
    noise = NOISE * rng.normal(size=(2, rows))

    def value(left):
        parts = [PartStatistics(rows, NOISE, smooth, nothing, nothing, nothing, left * fine + own) for own in noise]
        return densities([reduced(p) for p in parts], [0, 1], [True, False], np.empty(0), PHI)[0]

    assert share([PartStatistics(rows, NOISE, smooth, nothing, nothing, nothing, fine)]) == pytest.approx(5 / (rows - 5))
    assert 0.0 < value(0.9) - value(1.0) < 0.1


TABLE = Calibration(tuple(range(6)), (0.0,) * 9 + (3.0,))


def test_what_is_not_told_apart_is_a_class():
    found = [of(0.0), of(20.0, "a"), of(18.0, "b"), of(10.0, "c"), of(15.0, "a")]
    verdict = judged(found, TABLE)
    assert (verdict.answer, verdict.sets, verdict.lead) == ("class", (("a",), ("b",)), 20.0) and verdict.p_value == pytest.approx(1 / 7)
    assert [judged([of(0.0), of(v, "a")], TABLE).answer for v in (5.0, 5.01)] == ["none", "effect"]
    assert judged([of(0.0), of(20.0, "a"), of(19.0, "a:form")], TABLE).answer == "effect"  # forms of one effect
    assert [judged([of(0.0), of(20.0, "a", beyond=v)], TABLE).answer for v in (2.9, 3.1)] == ["effect", "unknown"]  # log 20
    assert judged([of(0.0), of(20.0, "a", beyond=3.1)], replace(TABLE, beyond=(4.0,))).answer == "effect"
    with pytest.raises(ValueError, match="declared model"):
        judged([of(1.0, "a")], TABLE)


def test_an_effect_that_adds_little_is_left_out():
    assert judged([of(0.0), of(20.0, "b", "a"), of(17.5, "a"), of(18.0, "c", "a")], TABLE).sets == (("a",),)
    assert judged([of(0.0), of(20.0, "b", "a"), of(16.0, "a")], TABLE).sets == (("a", "b"),)


def test_a_quantile_of_few_cases_is_a_conformal_one():
    """Of the next of n + 1 exchangeable cases at most a share alpha exceeds it."""
    rng = np.random.default_rng(13)
    values = rng.normal(size=(2000, 40))
    assert np.mean([own[-1] > quantile(own[:-1].tolist(), 0.1) for own in values]) == pytest.approx(0.1, abs=0.02)
    assert quantile([1.0, 3.0, 2.0], 0.05) == 3.0 and quantile([], 0.05) == math.inf
    assert quantile(list(range(39)), 0.05) == 37 and quantile(list(range(19)), 0.05) == 18


def test_the_shipped_table_judges():
    """An effect is named from the largest lead of a null on, since there are fewer nulls than 39."""
    own = calibration()
    assert len(own.nulls) >= 10 and len(own.effects) >= 9 and min(own.nulls + own.effects) >= 0.0
    assert own.least_lead() == max(own.nulls) and own.p_value(max(own.nulls) + 1.0) == 1 / (1 + len(own.nulls))
    assert 0.0 < own.class_margin() < own.least_lead()


def test_prior_weights_of_all_models_sum_to_one():
    weights = [-price(m, 6) + math.log(math.comb(6, m)) for m in range(KINDS)]
    assert logsumexp(weights) == pytest.approx(0.0)


def test_units_and_the_order_of_recordings_change_nothing():
    rng = np.random.default_rng(9)
    parts, variances = [part(rng), part(rng, rows=30), part(rng, rows=25)], np.array([2.0, 0.3])
    other = [replace(p, residual=p.residual - 0.7 * p.slopes[:, 0]) for p in parts]

    def value(parts, scale=0.4, order=(0, 1, 2)):
        return densities([parts[i] for i in order], list(order), [i < 2 for i in order], variances, scale)[0]

    def in_millimetres(p):
        own = {n: 1000.0 * getattr(p, n) for n in ("noise", "nuisances", "settings", "slopes", "residual")}
        return replace(p, **own)  # the patterns have no unit, their scale has

    assert value(parts, order=(1, 2, 0)) == pytest.approx(value(parts), rel=1e-9)
    big, other_big = ([in_millimetres(p) for p in own] for own in (parts, other))
    assert value(big, 400.0) - value(other_big, 400.0) == pytest.approx(value(parts) - value(other), rel=1e-6)
    assert unseen(big) == pytest.approx(1000.0 * unseen(parts))


@pytest.mark.parametrize(("truth", "answer"), [({"young": 1.5, "drag_linear.k": 0.8}, "effect"), ({"young": 1.5}, "none")])
def test_stored_fits_have_an_evidence(truth, answer):
    found = diagnose(Curve(truth), draws=39, statistics=True)
    fits = read(found.statistics)
    journal = SimpleNamespace(bases=found.case.bases, rounds=found.case.judged)
    assert {f.record.digest for f in fits} == {f.digest for f in best_fits(journal, (found.case.before, found.case.after))}
    assert found.case.after.digest in {f.record.digest for f in fits}
    made = evidences(found.case, fits)
    verdict = judged(made, calibration())
    assert verdict.answer == answer
    assert answer == "none" or verdict.sets == (("drag_linear",),)
    assert len(made) == len(fits) and all(np.isfinite(e.value) for e in made)
    with pytest.raises(ValueError, match="declared model"):
        evidences(
            found.case, [fit for fit in fits if fit.record.effects] or [replace(fits[0], record=replace(fits[0].record, effects=("a",)))]
        )


def test_the_fits_of_the_answer_are_kept_first():
    """The answer is fitted to its end after it was judged; a judged fit of the same effects may have stopped far from there."""

    def fit(error, *effects, at=0.0, finished=None):
        return FitRecord(0, effects, {"young": at}, (), 0.0, True, 1, 0, (error, error), (), finished=finished)

    before, far, end = fit(9.0, at=1.0), fit(4.0, "a"), fit(1.0, "a", at=1.0)
    others = [fit(0.5 + 0.01 * i, "b", f"c{i}") for i in range(40)]
    journal = SimpleNamespace(bases=[fit(10.0)], rounds=[SimpleNamespace(fits=[far, *others])])
    kept = best_fits(journal, (before, end))
    assert len(kept) == 24 and kept[:3] == [journal.bases[0], before, end]
    assert far not in kept and kept[3:] == others[:21]
    cut = fit(math.nan, "a", at=2.0)
    assert cut not in best_fits(journal, (before, cut))

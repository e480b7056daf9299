"""Figures as pictures: nothing is cut off, no legend or name lies on a curve, names do not lie on each other."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Annotation

import stochfuse as sf
from stochfuse.kalman.metrics import metric
from stochfuse.prediction.predict import predict_several
from stochfuse.report import comparisons, messages, predictions, reproductions, solutions
from stochfuse.report.plot import apart
from stochfuse.thesis import Bench, sheet

SCENARIO = sf.load_scenario("thesis-transient", steps=3)


def view(quantity="claimed", preset="thesis-transient", link=None, method=None, **changes):
    settings = {"runs": changes.pop("runs")} if "runs" in changes else {}
    scenario = sf.load_scenario(preset, **changes)
    p = sf.predict(scenario, link, method, quantity, **settings)
    return predictions.PredictionView(p, metric(scenario.metric or "trace", scenario.model))


def side(*quantities):
    several = predict_several(SCENARIO, [0, 0.3, 0.6, 1], "general", quantities)
    return predictions.draw_side([predictions.PredictionView(p, metric("trace", SCENARIO.model)) for p in several])


def compared():
    found = sf.compare(SCENARIO, [0, 0.5, 1], ["general", "simplified", "naive", "monte-carlo"], runs=50)
    views = tuple(predictions.PredictionView(p, metric("trace", SCENARIO.model)) for p in found.predictions)
    return comparisons.draw(comparisons.ComparisonView(found, views))


def estimators():
    found = sf.compare_estimators(SCENARIO, [0, 0.5, 1])
    return comparisons.draw_estimators(comparisons.EstimatorView(found, metric("trace", SCENARIO.model)))


def loads(kind):
    several = tuple(sf.message_load(SCENARIO, [0, 0.5, 1], rule) for rule in ("local-fusion-graph", "naive"))
    return messages.draw(messages.LoadView(several, several[1], kind))


def least():
    found = sf.least_link(SCENARIO, 40.0)
    return solutions.draw(solutions.least_link_sheet(found), found)


def sensitivity():
    found = sf.sensitivity(SCENARIO, 0.5)
    return solutions.draw(solutions.sensitivity_sheet(found), found)


def gain():
    found = sf.share_of_gain(SCENARIO)
    return solutions.draw(solutions.gain_sheet(found), found)


def simulated(preset, runs, **more):
    changes = {key: more.pop(key) for key in ("steps", "agents") if key in more}
    return sf.simulate(sf.load_scenario(preset, **changes), runs, link=0.5, predicted=False, **more).plot()


def states(steps, link):
    s = sf.load_scenario("cv-2d", steps=steps, agents=2)
    return sf.expected_states(s, np.ones((steps, 2, 2)), link, "general").plot()


FIGURES = {
    "run": lambda: simulated("thesis-steady", 20, steps=12, agents=2, estimator=["local-fusion-graph", "naive"]),
    "run of many agents": lambda: simulated("thesis-transient", 1, steps=5, agents=6, estimator="stand-alone"),
    "run of sensors by name": lambda: simulated("two-radars", 3, steps=30, estimator=["optimal", "split-ci"]),
    "states": lambda: states(3, [0, 0.5, 1]),
    "prediction": lambda: predictions.draw(view()),
    "many steps": lambda: predictions.draw(view(steps=40)),
    "one row": lambda: predictions.draw(view(link=[0.5])),
    "cases": lambda: predictions.draw(view(preset="fcs-demo")),
    "units": lambda: predictions.draw(view(preset="cv-2d", steps=4)),
    "sampled": lambda: predictions.draw(view(method="monte-carlo", runs=40, steps=3)),
    "three quantities": lambda: side("claimed", "actual", "optimal"),
    "two panels": lambda: side("claimed", "actual", "consistency"),
    "methods": compared,
    "estimators": estimators,
    "loads": lambda: loads("moments"),
    "distribution of loads": lambda: loads("distribution"),
    "cdf of loads": lambda: loads("cdf"),
    "least link": least,
    "sensitivity": sensitivity,
    "gain": gain,
    "figure 32": lambda: reproductions.draw(sheet("figure-32", Bench(steps=2))),
    "table 3": lambda: reproductions.draw(sheet("table-3", Bench(steps=2))),
}


@pytest.fixture(scope="module", params=FIGURES)
def drawn(request):
    figure = FIGURES[request.param]()
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return figure, canvas.get_renderer()


def texts_of(figure):
    found = [figure._suptitle] if figure._suptitle is not None else []
    for axes in figure.axes:
        found += [axes.title, axes.xaxis.label, axes.yaxis.label, *axes.texts]
    return [text for text in found if text.get_text()]


def legends_of(figure):
    return [*figure.legends, *(axes.get_legend() for axes in figure.axes if axes.get_legend() is not None)]


def extent(artist, renderer):
    """Box of an artist, of an annotation without its arrow."""
    return (super(Annotation, artist) if isinstance(artist, Annotation) else artist).get_window_extent(renderer)


@pytest.mark.slow
def test_nothing_is_cut_off(drawn):
    figure, renderer = drawn
    whole = figure.bbox
    for artist in (*texts_of(figure), *legends_of(figure)):
        box = extent(artist, renderer)
        assert min(box.x0 - whole.x0, box.y0 - whole.y0, whole.x1 - box.x1, whole.y1 - box.y1) > -1, artist


def test_no_legend_or_name_lies_on_a_curve(drawn):
    figure, renderer = drawn
    for artist in (*legends_of(figure), *(t for t in texts_of(figure) if isinstance(t, Annotation))):
        box = extent(artist, renderer)
        for axes in figure.axes:
            assert not box.overlaps(axes.get_window_extent(renderer)), artist


def test_no_text_lies_on_another(drawn):
    figure, renderer = drawn

    boxes = [(str(artist), extent(artist, renderer)) for artist in (*texts_of(figure), *legends_of(figure))]
    for (name, one), (other, two) in combinations(boxes, 2):
        assert not (one.shrunk(0.98, 0.9).overlaps(two.shrunk(0.98, 0.9))), (name, other)


def test_both_axes_are_named(drawn):
    for axes in drawn[0].axes:
        # of panels above each other the lowest names the axis for all
        assert any(other.get_xlabel() for other in axes.get_shared_x_axes().get_siblings(axes))
        assert axes.get_ylabel()


def test_curves_are_smooth_and_pass_through_what_was_asked():
    figure = predictions.draw(view(link=[0, 0.25, 0.5, 0.75, 1]))
    lines = figure.axes[0].get_lines()
    curves, marks = (
        [line for line in lines if len(line.get_xdata()) > 100],
        [line for line in lines if len(line.get_xdata()) == 5],
    )
    assert len(curves) == len(marks) == 5
    for curve, mark in zip(curves, marks, strict=True):
        np.testing.assert_allclose(
            np.interp(mark.get_xdata(), curve.get_xdata(), curve.get_ydata()), mark.get_ydata(), rtol=1e-12
        )


def test_curves_are_told_apart_without_colour():
    lines = [line for line in predictions.draw(view()).axes[0].get_lines() if len(line.get_xdata()) > 100]
    assert len({str(line._dash_pattern) for line in lines}) == len(lines)


@pytest.mark.parametrize("wanted", [[0.5], [0.1, 0.1, 0.1], [0.9, 0.1, 0.12, 0.11], list(np.linspace(0, 0.1, 8))])
def test_names_are_moved_apart_and_keep_their_order(wanted):
    wanted = np.array(wanted)
    places = apart(wanted, 0.05)
    order = np.argsort(wanted, kind="stable")
    assert (np.diff(places[order]) >= 0.05 - 1e-12).all()
    assert abs(places.mean() - wanted.mean()) < 0.05

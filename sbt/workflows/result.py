"""What a campaign gave: its rows, its conclusion, its metamodel, its figures and films."""

from __future__ import annotations

import base64
import html
import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from sbt.campaigns.estimation import EstimationConclusion
from sbt.campaigns.preventable import with_judgements
from sbt.campaigns.wording import failed_words, plural
from sbt.errors import InputError, StoreError
from sbt.execution.carrying import packed, unpacked
from sbt.loop.learner import FittedMetamodel
from sbt.loop.stages import Conclusion, Facts, sentences_of
from sbt.plugins import OBJECT, Objects
from sbt.plugins.approval import is_trusted, trust_store
from sbt.problem.plain import Json
from sbt.problem.scenario import LogicalScenario
from sbt.problem.trace import Trace
from sbt.store.database import Store
from sbt.store.history import History
from sbt.store.records import FitRecord, Judgement
from sbt.workflows.asking import Answer, estimate_again
from sbt.workflows.changes import told
from sbt.workflows.exporting import export_store
from sbt.workflows.judging import judge_run, with_driver
from sbt.workflows.keywords import as_data
from sbt.workflows.plots import Plots
from sbt.workflows.rechecking import not_repeated
from sbt.workflows.running import Replay, rebuild_report, replay_run
from sbt.workflows.showing import net_of_run, save_film, shown_trace
from sbt.workflows.study import Study

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["Film", "Page", "Result"]

C = TypeVar("C", bound=Conclusion, covariant=True)


def _opened(store: str, objects: Mapping[tuple[str, str], bytes], trusted: bool) -> Result[Any]:
    """Return a result from what a pickle kept of it; code of the store that was approved there is here, too."""
    if trusted:
        trust_store(Path(store))
    return Result(Path(store), unpacked(objects))


@dataclass(frozen=True, eq=False, repr=False)
class Result(Generic[C]):
    """A campaign's store, read: as it was when the result was first asked; open it again to see more of a running one.

    Args:
        store: the folder.
        objects: what was given in Python when it was made, by kind and name.
    """

    store: Path
    objects: Objects = field(default_factory=dict)

    def __reduce__(self) -> tuple[Callable[..., Result[Any]], tuple[Any, ...]]:
        """Return what a pickle keeps: where the store is, which is read again, and of the objects those that can travel."""
        return _opened, (str(Path(self.store).absolute()), packed(self.objects), is_trusted(self.store))

    @cached_property
    def _read(self) -> tuple[Study, History, Json, list[FitRecord]]:
        with Store.read(self.store) as store:
            return Study.from_store(store, objects=self.objects), store.history(), store.conclusion or {}, store.fits()

    @property
    def study(self) -> Study:
        """The campaign as it is configured."""
        return self._read[0]

    @property
    def scenario(self) -> LogicalScenario:
        """The scenario with the campaign's inputs and requirement; it runs only where its code is at hand."""
        return self.study.scenario

    @property
    def history(self) -> History:
        """All finished runs as columns."""
        return self._read[1]

    @property
    def fits(self) -> list[FitRecord]:
        """Scores of every metamodel that was fitted."""
        return self._read[3]

    @property
    def finished(self) -> bool:
        """Whether the campaign has concluded."""
        return bool(self._read[2])

    @property
    def summary(self) -> Json:
        """What `run --json` prints; empty while the campaign goes on."""
        return dict(self._read[2])

    @cached_property
    def conclusion(self) -> C:
        """What the campaign found, with typed attributes.

        Raises:
            StoreError: it has not concluded.
        """
        if not self.finished:
            raise StoreError(f"the campaign in {self.store} has not concluded: {len(self.history)} runs are done")
        found: Any = self.study.conclusion(self.summary["conclusion"])
        return found

    @property
    def frame(self) -> pd.DataFrame:
        """A row a run: x.<input>, y.<metric>, critical, margin, status, stage, iteration, seed, log_q, ...; a copy each time."""
        return self._frame.copy()

    @cached_property
    def _frame(self) -> pd.DataFrame:
        return with_judgements(self.history.to_frame(self.scenario.requirement), self.judgements)

    @cached_property
    def judgements(self) -> list[Judgement]:
        """What reference drivers in the place of the ego made of the failures."""
        with Store.read(self.store) as store:
            return store.judgements

    def preventable(self, run: int | None = None, drivers: Sequence[str] | None = None) -> pd.DataFrame:
        """Return which reference drivers would have avoided a run: the same inputs and seed, with each in the place of the ego.

        Args:
            run: its index, executed with each driver unless that was done; None: the runs that the campaign has judged.
            drivers: kinds of ego; None: those of the campaign, or cc_human, reg157, rss and fsm.

        Returns:
            A row a run and driver: run, driver, avoided (NA: not applicable), collision, metric, reason.

        Raises:
            InputError: there is no such run or driver, or the scenario's code is not at hand.
        """
        import pandas as pd

        found = self.judgements if run is None else judge_run(self.store, run, drivers, objects=self.objects)
        frame = pd.DataFrame([vars(each) for each in found], columns=[f.name for f in fields(Judgement)])
        return frame.astype({"avoided": "boolean", "collision": "boolean", "metric": float})

    @cached_property
    def fitted(self) -> FittedMetamodel | None:
        """The metamodel that learned from all runs but the held-out ones, with its scores on those; None without one."""
        learner, fitted = self.study.learner, self.study.fit(self.history)
        if learner is None or fitted is None:
            return None
        return replace(fitted, predict=learner.told(fitted.predict, self.history, self.history.training))

    @property
    def plot(self) -> Plots:
        """Figures; each takes `ax=None` and returns the Axes."""
        return Plots(self)

    def predict(self, inputs: Any, *, device: str | None = None) -> pd.DataFrame:
        """Return what the metamodel, learned from all runs, predicts about concrete scenarios.

        Args:
            inputs: a DataFrame or a mapping with a column (or one number) for each input, named as the input or
                `x.<input>`; or an array (n, d).
            device: auto, cpu or cuda; None: where the metamodel was fitted.

        Returns:
            Columns mean, std, epistemic, noise (unit of the metric) and p_critical, with the rows' index. Where some runs gave
            no metric also p_fails, the probability of that: the others are of a run that gives one.

        Raises:
            InputError: a column is missing, a value is outside of its range, or there is no metamodel.
        """
        import pandas as pd

        from sbt.workflows.prediction import inputs_from, predict_inputs  # all metamodels, and so torch

        table = predict_inputs(self.store, lambda space: inputs_from(inputs, space), device=device, objects=self.objects)
        columns = {{"mu": "mean", "sigma": "std"}.get(name, name): values for name, values in table.columns.items()}
        return pd.DataFrame(columns, index=inputs.index if isinstance(inputs, pd.DataFrame) else None)

    def estimate(
        self, inputs: Any = None, *, critical: Sequence[float | None] | None = None, metric: str | None = None
    ) -> EstimationConclusion:
        """Return the probability under other distributions, or of another requirement, from the runs that are there.

        Args:
            inputs: changes to the campaign's inputs, as the key of a configuration; None: its own distributions.
            critical: interval (low, high) of critical values, None for an end that is open; None: the campaign's.
            metric: one that the runs measured; None: the campaign's.

        Raises:
            InputError: the runs cannot tell: no known densities, none where the distributions have mass, unknown inputs.
        """
        return self._asked(inputs, critical, metric).conclusion

    def sensitivity(
        self, inputs: Any = None, *, critical: Sequence[float | None] | None = None, metric: str | None = None
    ) -> pd.DataFrame:
        """Return how the probability P depends on each parameter of the distributions; arguments as `estimate`.

        Returns:
            A row a parameter: input, parameter, value, derivative, std_error, elasticity, change, raised, lowered (P with the
            parameter larger and smaller by `change`). What is not known is None or NaN (`sbt.campaigns.asking.Sensitivity`).
        """
        import pandas as pd

        return pd.DataFrame([vars(each) for each in self._asked(inputs, critical, metric).sensitivity])

    def _asked(self, inputs: Any, critical: Sequence[float | None] | None, metric: str | None) -> Answer:
        given, _ = as_data({"inputs": inputs or {}})
        if critical is None:
            interval = None
        else:
            rule = "critical must be an interval (low, high), None for an end that is open"
            try:
                low, high = critical
                interval = (-math.inf if low is None else float(low), math.inf if high is None else float(high))
            except (TypeError, ValueError):
                raise InputError(f"{rule}, but got {critical!r}") from None
        return estimate_again(self.store, given["inputs"], critical=interval, metric=metric, objects=self.objects)

    def replay(self, run: int) -> Replay:
        """Execute a stored run again, and make sure that what is stored of it is the same to the last bit.

        It is `identical` unless files were `changed` since: then what is not stored may differ.

        Args:
            run: its index, from 0.

        Raises:
            InputError: there is no such run, or the scenario's code is not at hand.
            StoreError: it is not the same.
        """
        again = replay_run(self.store, run, objects=self.objects)
        if not again.as_stored:
            rule = f"a replay must equal the stored run {run}, but got {again.differing}"
            raise StoreError(rule + (told(again.changed) or not_repeated(again.scenario)))
        return again

    def trace(self, run: int) -> pd.DataFrame:
        """Return the states of every road user over time in a run, by executing it again, verified.

        Args:
            run: its index, from 0.

        Returns:
            Columns time (s), actor, x, y (m), heading (rad), speed (m/s), acceleration (m/s^2), length, width (m).
        """
        import pandas as pd

        return pd.DataFrame(shown_trace(self.replay(run)).rows())

    def film(self, run: int, driver: str | None = None) -> Film:
        """Return a run as a film from above, with its metric over time; by executing it again, verified.

        Args:
            run: its index, from 0.
            driver: who is in the place of the ego in the film, such as fsm; None: the ego itself.
        """
        again, title = self.replay(run), f"{self.scenario.name}, run {run}"
        if driver is not None:
            again, title = with_driver(again, driver), f"{title}, {driver} in the place of ego"
        return Film(shown_trace(again), again.scenario, title, net_of_run(again))

    def report(self) -> Path:
        """Write `report.html` in the store's folder, and return its path."""
        return rebuild_report(self.store, objects=self.objects)

    def export(self, form: str = "csv") -> Path:
        """Write the runs as csv, parquet, dsiod or boundary points into the store's folder, and return the path."""
        return export_store(self.store, form, objects=self.objects)

    def explore(self, height: int = 900) -> Page:
        """Return the report as a page that a notebook shows in place, with its interactive figures and films.

        Args:
            height: of the frame (px).
        """
        with tempfile.TemporaryDirectory() as folder:
            path = rebuild_report(self.store, objects=self.objects, target=Path(folder))
            return Page(path.read_text(encoding="utf-8"), height)

    def sentences(self) -> list[str]:
        """Return what the campaign found in plain words."""
        if not self.finished:
            return [f"The campaign has not concluded: {len(self.history):,} runs are done."]
        said = sentences_of(self.conclusion, Facts.of(self.history, self.scenario))
        return [*said, *map(str, getattr(self.conclusion, "warnings", ())), *self._failures()]

    def _failures(self) -> list[str]:
        """Return how many runs gave no metrics, and why the first did not."""
        return [words] if (words := failed_words(self.history)) else []

    def __repr__(self) -> str:
        """Return campaign, scenario and counts."""
        config, critical = self.study.config, int(self.scenario.requirement.critical_runs(self.history).sum())
        what = f"{config.campaign} of {config.scenario}".replace(OBJECT, "")
        failed = len(self.history) - int(self.history.ok.sum())
        counts = f"{plural(len(self.history), 'run')}, {critical:,} critical" + (f", {failed:,} failed" if failed else "")
        return f"<Result: {what}, {counts}, in {self.store}>"

    def _repr_html_(self) -> str:
        """Return the summary that a notebook shows."""
        config, ok = self.study.config, int(self.history.ok.sum())
        critical = int(self.scenario.requirement.critical_runs(self.history).sum())
        facts = {
            "campaign": config.campaign.removeprefix(OBJECT), "scenario": config.scenario.removeprefix(OBJECT),
            "runs": f"{len(self.history):,}", "critical": f"{critical:,}", "failed": f"{len(self.history) - ok:,}",
            "store": str(self.store),
        }  # fmt: skip
        pairs = ((html.escape(name), html.escape(value)) for name, value in facts.items())
        rows = "".join(f"<tr><th style='text-align:left'>{name}</th><td>{value}</td></tr>" for name, value in pairs)
        said = "".join(f"<p>{html.escape(sentence)}</p>" for sentence in self.sentences())
        return f"<div>{said}<table>{rows}</table></div>"


@dataclass(frozen=True, eq=False, repr=False)
class Page:
    """A page of its own that a notebook shows in a frame.

    Args:
        text: HTML.
        height: of the frame (px).
    """

    text: str
    height: int = 900

    def _repr_html_(self) -> str:
        """Return the page in a frame; its scripts and styles stay inside."""
        inside = html.escape(self.text)
        return f'<iframe title="report" srcdoc="{inside}" style="width:100%;height:{self.height}px;border:0"></iframe>'


@dataclass(frozen=True, eq=False, repr=False)
class Film:
    """A run from above, with its metric over time.

    Args:
        states: the run.
        scenario: names metric and requirement.
        title: above the scene.
        net: network file whose lanes are drawn, None: none.
    """

    states: Trace
    scenario: LogicalScenario
    title: str = ""
    net: Path | None = None

    def save(self, path: str | Path) -> Path:
        """Write the film in real time as .gif, .webp, .mp4 or .webm, and return its path.

        Raises:
            InputError: the name ends otherwise, or ffmpeg is needed and not there.
        """
        file = Path(path)
        save_film(file, self.states, self.scenario, self.title, self.net)
        return file

    def _repr_html_(self) -> str:
        """Return the film inline."""
        with tempfile.TemporaryDirectory() as folder:
            data = self.save(Path(folder) / "film.gif").read_bytes()
        return f'<img alt="{html.escape(self.title)}" src="data:image/gif;base64,{base64.b64encode(data).decode()}">'

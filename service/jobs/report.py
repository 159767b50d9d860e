"""The report of a job whose runner handed no page over: the scores without pictures."""

from typing import Any

from service.errors import NotReadyError


class _Scores:
    """An evaluation as `service.report` takes it, made of a job's result."""

    def __init__(self, result: dict[str, Any]) -> None:
        self.result = result
        self.pictures: list[Any] = []


def job_report(job_id: str, result: dict[str, Any]) -> str:
    """The page of a job's evaluation.

    Raises:
        NotReadyError: the job was not asked to evaluate.
    """
    if result.get("evaluation") is None:
        raise NotReadyError(f"job {job_id} must have the stage evaluate for a report, its stages end before it")
    from service.report import render_report

    return render_report(_Scores(result["evaluation"]), command=f"lightwell jobs show {job_id}")  # type: ignore[arg-type]

"""`trustbo report`: a result as one page."""

from pathlib import Path

from trustbo.cli.errors import one_line_errors
from trustbo.cli.outputs import use_no_screen


def report(
    folder: Path, out: Path | None = None, title: str | None = None, debug: bool = False
) -> None:
    """Write a result as one HTML page, with all its figures and tables.

    Example: trustbo report out/demo --out demo.html

    The page needs no network and no other file. For a campaign that was
    interrupted, it shows the missions learned from until then.
    """
    with one_line_errors(debug):
        from trustbo.campaign.result import load_result

        result = load_result(folder)
        use_no_screen()
        from trustbo.report import write_report

        file = folder / "report.html" if out is None else Path(out)
        write_report(file, result, title=title)
        print(f"the report is {file}")

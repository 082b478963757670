"""Names of the files in the folder of a campaign or a result; an import that loads little."""

from pathlib import Path

from trustbo.errors import TrustboError

STATE, RESULT, WORKSPACE, MEASURED = "campaign.json", "result.json", "workspace.nc", "measured.nc"
MISSIONS, HISTORY, TABLE = "missions.nc", "history.nc", "history.csv"
POSTERIOR = "posterior.nc"
FILES = (
    STATE, RESULT, MEASURED, MISSIONS, HISTORY, TABLE, POSTERIOR, WORKSPACE,
)  # fmt: skip
"""All of these, the records first: what they describe is removed after them."""
POSTERIORS, TICKS = "posteriors", "ticks"
"""Folders of numbered files."""


def require_free(folder: Path) -> None:
    """Refuse a folder that holds a campaign, or a file of such a name: TrustboError.

    The workspace alone is that of a campaign whose first write was interrupted.
    """
    if (folder / STATE).exists():
        raise TrustboError(
            f"{str(folder)!r} holds a campaign already: go on with it by Campaign.load, choose "
            "another folder, or replace it with overwrite=True."
        )
    for name in FILES:
        if name != WORKSPACE and (folder / name).exists():
            raise TrustboError(
                f"{str(folder)!r} holds {name}, which would be replaced; choose another folder, or "
                "replace it with overwrite=True."
            )

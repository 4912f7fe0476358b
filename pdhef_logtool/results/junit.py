"""JUnit XML of a validation plan or a comparison: one testcase per requirement or figure, as CI systems read it.

An INCONCLUSIVE requirement is a skipped test. Checks that did not pass are properties: they fail no test.
"""

import re
from collections.abc import Mapping, Sequence
from typing import Any

from pdhef_logtool.evaluation.validation_plan import shown
from pdhef_logtool.results.plan_verdicts import PlanVerdicts
from pdhef_logtool.results.selected_estimate import TEMPLATES
from pdhef_logtool.storage.templates import template

#: Characters that XML 1.0 cannot contain.
_NOT_IN_XML = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")


def junit_bytes(
    verdicts: PlanVerdicts | None, checks: Mapping[str, Sequence[Mapping[str, Any]]] | None = None, **compared: Any
) -> bytes:
    """Return JUnit XML in UTF-8; the same verdicts give the same bytes, so that there is no time of day in it.

    ``checks`` : by log the rows of its checks (checks.parquet). ``compared`` : a ``comparison`` with the functions
    that write its figures.
    """
    fields = {"verdicts": verdicts, "checks": checks or {}, "comparison": None, **compared}
    return _NOT_IN_XML.sub("?", template(TEMPLATES / "junit.xml", shown=shown).render(fields)).encode()

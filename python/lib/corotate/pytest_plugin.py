"""pytest: a run as a fixture, with its report attached where a test fails."""

import pytest


@pytest.fixture
def corotate_run(request, tmp_path):
    """`corotate.run`, into the test's own directory and recorded: its verdict and hash go to JUnit, and where the test fails the
    path of its report is printed.
    """
    import corotate
    runs = []

    def run(scenario, **options):
        __tracebackhide__ = True
        options.setdefault("out", tmp_path / f"run-{len(runs)}")
        options.setdefault("record", options.get("clock") != "in-process" or not options.get("roles"))
        made = corotate.run(scenario, **options)
        runs.append(made)
        # As the fixture record_property, which warns where JUnit's newer schema is asked for.
        request.node.user_properties += [
            ("corotate.accepted", made.accepted), ("corotate.hash", made.hash), ("corotate.directory", str(made.directory))]
        return made

    yield run
    report = getattr(request.node, "_corotate_report", None)
    if report is not None and report.failed:
        for made in runs:
            if (made.directory / "run.mcap").exists():
                print(f"corotate: {made!r}\ncorotate: its report is {made.report()}")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    report = yield
    if call.when == "call":
        item._corotate_report = report
    return report

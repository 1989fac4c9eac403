"""Functions fit a screen, and tests stand where the modules stand."""

from __future__ import annotations

import ast
from pathlib import Path

from tests.documents.blocks import ROOT

LONGEST = 60
#: Compiled inner loops: a call would have to pass, and allocate, what they keep in registers.
KERNELS = {
    "impc/control/compiled_dual.py": {"solve_dual"},
}
#: Test file -> modules of impc that have none of their own name, and are tested there.
ELSEWHERE = {
    "test_checking.py": "arrays.py errors.py",
    "test_public.py": "studies/estimate_page.py",
    "test_reporting.py": """
        reporting/lock.py reporting/provenance.py reporting/rendering.py reporting/style.py
        reporting/writer.py studies/example/figures.py reporting/document.py files/columns.py
        reporting/glossary.py studies/example/report.py studies/example/result.py""",
    "assess/test_all_intervals.py": "assess/judged.py assess/other_models.py",
    "assess/test_bounded_weights.py": "assess/extreme_weights.py assess/intent_statements.py",
    "assess/test_covariance.py": "assess/printed_gain.py",
    "assess/test_diagnostics.py": "assess/loop_noise.py assess/residual_structure.py",
    "assess/test_intent_draws.py": "assess/weights_ranges.py studies/fit/tables.py",
    "assess/test_structures.py": """
        assess/near_fit.py assess/price_profiles.py assess/structure_test.py
        assess/structured_weights.py""",
    "assess/test_resampling.py": "assess/intervals.py assess/profiles.py",
    "cli/test_ending.py": "cli/exit_status.py",
    "cli/test_fit.py": """
        cli/simulate.py cli/subject.py cli/output.py
        cli/seat.py studies/fit/csv_tables.py
        studies/fit/report.py studies/fit/schema.py studies/fit/sentences.py""",
    "cli/test_folders.py": "cli/options.py",
    "cli/test_main.py": """
        cli/example.py cli/numbers.py studies/example/cases.py studies/example/table.py""",
    "cli/test_optimal_subject.py": """
        files/optimal_reading.py studies/optimal_fit/figures.py studies/optimal_fit/report.py
        studies/optimal_fit/result.py studies/optimal_fit/sentences.py
        studies/optimal_fit/settings.py""",
    "cli/test_plan.py": """
        studies/plan/figures.py studies/plan/report.py studies/plan/sentences.py""",
    "cli/test_reliability.py": """
        cli/simulate_reliability.py studies/reliability/analysis.py studies/reliability/figures.py
        studies/reliability/findings.py studies/reliability/report.py
        studies/reliability/tables.py""",
    "control/test_body_steps.py": "control/compiled_body.py",
    "control/test_closed_loop.py": """
        control/compiled_kernel.py control/compiled_kernel.py control/compiled_dual.py
        control/compiled_kernel.py control/compiled_kernel.py control/constraint_rows.py""",
    "control/test_joint_likelihood.py": """
        control/compiled_clip.py control/compiled_covariance.py control/compiled_filter.py
        control/compiled_person.py control/compiled_room.py control/compiled_sample.py
        control/compiled_products.py control/compiled_slope.py control/joint_loop.py
        control/noisy_person.py""",
    "control/test_hard_plants.py": "control/infeasibility.py control/saturated.py",
    "control/test_optimal_control.py": """
        control/nlp_solvers.py control/optimal_recordings.py""",
    "control/test_plan.py": """
        control/plan_derivatives.py control/relaxed_conditions.py""",
    "control/test_loop_function.py": "control/casadi_callback.py",
    "control/test_seat_workload.py": "assess/identified_directions.py",
    "control/test_terminal_set.py": "control/halfspaces.py control/polygon.py",
    "files/test_apart.py": "files/reader_process.py",
    "files/test_digests.py": "studies/cohort/unit_digest.py",
    "files/test_faults.py": "files/writing.py",
    "files/test_formats.py": """
        files/c3d_analog.py files/delimited.py files/headings.py files/matlab73.py
        files/table.py files/tdms.py files/thousands.py""",
    "files/test_spreadsheet.py": "files/workbook.py",
    "files/test_inspection.py": "cli/inspect.py",
    "files/test_matlab.py": "files/matlab_tags.py",
    "files/test_names.py": "reporting/csv_text.py",
    "files/test_plant_sources.py": """
        cli/plant.py files/saved_plant.py studies/selection/model_source.py""",
    "files/test_reading.py": """
        files/alignment.py files/checks.py files/clock.py files/measurable.py
        model/recordings.py""",
    "inverse/test_direct_and_reduced.py": """
        inverse/cross_term.py inverse/gain_search.py inverse/problem.py inverse/proximal_search.py
        inverse/proximal_step.py inverse/residuals.py""",
    "inverse/test_equivalent_weights.py": "inverse/solution_set.py",
    "inverse/test_noisy_fit.py": """
        inverse/groundwork.py inverse/coordinates.py inverse/initial_states.py
        inverse/natural_search.py model/plant_family.py""",
    "inverse/test_several_inputs.py": """
        inverse/consistent_metrics.py inverse/explaining_weights.py
        inverse/inactive_samples.py""",
    "inverse/test_default_answer.py": "inverse/starting_regulators.py",
    "inverse/test_likelihood_fit.py": "inverse/likelihood_start.py inverse/person_coordinates.py",
    "inverse/test_likelihood_search.py": "inverse/person_prior.py",
    "assess/test_person_covariance.py": "inverse/trial_span.py",
    "inverse/test_structured_fit.py": "inverse/structured_search.py",
    "inverse/test_optimal_control_fit.py": """
        inverse/optimal_control_residuals.py inverse/optimal_control_search.py
        inverse/told_combinations.py""",
    "inverse/test_stationarity.py": "inverse/smoothing.py",
    "model/test_riccati.py": "model/bounds.py model/plant.py model/weights.py",
    "model/test_structure.py": "model/combinations.py",
    "studies/plan/test_study.py": """
        studies/plan/designs.py studies/plan/settings.py studies/plan/simulated_fits.py""",
    "studies/cohort/test_store.py": """
        studies/cohort/engine.py studies/cohort/report.py studies/cohort/subject_page.py
        studies/cohort/tables.py studies/cohort/unit_task.py""",
    "studies/cohort/test_study.py": """
        studies/cohort/figures.py studies/cohort/finding.py studies/cohort/names.py
        studies/cohort/sheet.py studies/cohort/tasks.py""",
    "studies/compare/test_subject.py": """
        cli/compare.py inverse/estimates.py inverse/methods.py studies/compare/csv_tables.py
        studies/compare/report.py""",
    "studies/fit/test_settings.py": "studies/fit/asked.py",
    "studies/fit/test_verdict.py": """
        studies/charts.py studies/fit/interval_figures.py studies/signal_words.py""",
    "studies/fit/test_subject.py": """
        inverse/delayed_feedback.py assess/held_out.py assess/intent_rules.py
        studies/fit/result.py""",
    "studies/reliability/test_anova.py": "studies/reliability/variance_components.py",
    "studies/reliability/test_transfer.py": """
        studies/reliability/cmc.py studies/reliability/measures.py""",
    "studies/selection/test_fisher.py": """
        studies/selection/estimation.py studies/selection/linear.py studies/selection/model.py
        studies/selection/modern.py studies/selection/subsets.py""",
    "studies/selection/test_methods.py": """
        cli/key_parameters.py cli/select.py cli/simulate_head_tracking.py
        studies/selection/analysis.py studies/selection/bootstrap.py
        studies/selection/key_parameters.py studies/selection/key_report.py
        studies/selection/report.py studies/selection/settings.py studies/selection/subject.py""",
    "studies/test_effort.py": """
        cli/consent.py studies/cohort/effort.py studies/selection/effort.py""",
    "inverse/test_many_trials.py": "studies/fit/figures.py",
}


def lines(node: ast.FunctionDef) -> int:
    """Of its code, without the docstring and its example."""
    told = node.body[0] if ast.get_docstring(node) else None
    whole = (node.end_lineno or 0) - node.lineno + 1
    return whole - (0 if told is None else (told.end_lineno or 0) - told.lineno + 1)


def test_functions_fit_a_screen() -> None:
    long: dict[str, set[str]] = {}
    for package in ("impc", "plants"):
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.FunctionDef) and lines(node) > LONGEST:
                    long.setdefault(path.relative_to(ROOT).as_posix(), set()).add(node.name)
    assert long == KERNELS


def test_every_module_has_a_test_file_of_its_name_or_is_listed() -> None:
    """A module that is added has its file; one that gets it leaves the list."""
    without = {
        path.relative_to(ROOT / "impc").as_posix()
        for path in (ROOT / "impc").rglob("*.py")
        if not path.stem.startswith("__")
        and not own_file(path.relative_to(ROOT / "impc")).is_file()
    }
    listed = [module for modules in ELSEWHERE.values() for module in modules.split()]
    assert len(listed) == len(set(listed))
    assert without - set(listed) == set(), "write tests/<room>/test_<module>.py"
    assert set(listed) - without == set(), "to be taken off the list"
    assert [file for file in ELSEWHERE if not (ROOT / "tests" / file).is_file()] == []


def own_file(module: Path) -> Path:
    return ROOT / "tests" / module.parent / f"test_{module.name}"

"""What laboratories measure, key by key: effect or kind of data, its closed form, its gradient, and its made case in the blind harness.

    python -m tests.discrepancy.library_coverage --out research/results/loop_library.md

Each entry names its tests, as file and function below `tests`; `test_library_coverage.py` holds that they exist and that the cases can be
drawn.
"""

import argparse
from pathlib import Path
from typing import NamedTuple

from neuido.data.files.writing import write_text


class Entry(NamedTuple):
    """One effect or kind of data."""

    group: str
    what: str
    name: str
    """Name in the library, or the format that expresses it."""
    closed: str
    """Test against a closed form or a refined computation."""
    gradient: str
    """Test of its derivatives or slopes."""
    measured: str
    """`Case.measured` of its made cases; or a test that makes them."""
    kind: str = ""
    """`Case.kind`; empty: any."""


LAW, POINT, FLOW = "physics/points/test_point_law.py", "physics/points/test_material_point.py", "physics/points/test_flow_curve.py"
GUIDED, MASS = "physics/points/test_guided_points.py", "physics/points/test_point_mass.py"
KINDS_OF_TEST, PLANE = "discrepancy/problems/test_kinds_of_test.py", "physics/plane/test_plane_specimen.py"
SLOPES = f"{LAW}::test_derivatives_of_every_parameter_are_those_of_differences"
MADE_PLATES = "discrepancy/problems/test_plane.py::test_the_right_answer"
FLOWS = f"{FLOW}::test_slopes_by_the_parameters"
GUIDES = f"{GUIDED}::test_slopes_by_the_parameters_are_those_of_the_closed_forms"
GRIPS = "physics/colliders/test_grips.py"

ENTRIES = (
    Entry("Solids", "relaxation spectrum, five branches", "relaxation_spectrum",
          f"{LAW}::test_a_spectrum_and_a_power_law_relax_as_their_closed_forms", SLOPES, "material_test", "relaxation_spectrum"),
    Entry("Solids", "fractional element", "fractional", f"{LAW}::test_a_spectrum_and_a_power_law_relax_as_their_closed_forms", SLOPES,
          "material_test", "fractional"),
    Entry("Solids", "Mullins softening", "mullins", f"{LAW}::test_mullins_leaves_the_first_loading_alone_and_softens_the_way_back", SLOPES,
          "material_test", "mullins"),
    Entry("Solids", "damage", "softening", "physics/effects/test_constitutive.py::test_softening_without_a_yield_stress_is_damage",
          SLOPES, "material_test", "softening"),
    Entry("Solids", "permanent set", "permanent_set", f"{LAW}::test_a_permanent_set_is_the_stretch_without_stress", SLOPES,
          "material_test", "permanent_set"),
    Entry("Solids", "compaction", "compaction", f"{LAW}::test_compaction_rises_towards_the_locking_strain", SLOPES, "material_test",
          "compaction"),
    Entry("Solids", "creep", "creep", f"{LAW}::test_creep_flows_at_the_rate_of_the_stress", SLOPES, "material_test", "creep"),
    Entry("Solids", "nonlinear backstress, up to three", "nonlinear_backstress",
          f"{LAW}::test_hardening_that_saturates_and_backstress_that_fades", SLOPES, "material_test", "nonlinear_backstress"),
    Entry("Solids", "cyclic hardening and softening", "cyclic_hardening",
          f"{LAW}::test_hardening_that_saturates_and_backstress_that_fades", SLOPES, "material_test", "cyclic_hardening"),
    Entry("Solids", "hardening after yield", "hardening", f"{POINT}::test_isotropic_hardening_grows_the_loop", SLOPES, "material_test",
          "hardening"),
    Entry("Solids", "rate after yield", "rate_power", f"{LAW}::test_flow_stress_is_that_of_herschel_and_bulkley", SLOPES, "material_test",
          "rate_power"),
    Entry("Solids", "backstress after yield", "kinematic_hardening", f"{POINT}::test_kinematic_hardening_loop", SLOPES, "material_test",
          "kinematic_hardening"),
    Entry("Flow", "Newtonian", "model.flow", f"{FLOW}::test_newton", FLOWS, "material_test", "none"),
    Entry("Flow", "power law", "power_law", f"{FLOW}::test_a_power_law_has_its_slope_and_its_reference", FLOWS, "material_test",
          "power_law"),
    Entry("Flow", "Carreau", "carreau", f"{FLOW}::test_carreau_has_two_limits", FLOWS, "material_test", "carreau"),
    Entry("Flow", "Herschel-Bulkley", "herschel_bulkley", f"{FLOW}::test_bingham_and_herschel_bulkley", FLOWS, "material_test",
          "herschel_bulkley"),
    Entry("Flow", "yield stress alone", "bingham", f"{FLOW}::test_bingham_and_herschel_bulkley", FLOWS, "material_test", "bingham"),
    Entry("Flow", "thixotropy, one structure parameter", "thixotropy",
          f"{FLOW}::test_a_thixotropic_fluid_at_one_rate_falls_exponentially", FLOWS, "material_test", "thixotropy"),
    Entry("Guided points", "pendulum of finite amplitude", "constraint pendulum",
          f"{GUIDED}::test_a_pendulum_swings_with_its_period_of_finite_amplitude", GUIDES, "guided", "pendulum:drag_linear"),
    Entry("Guided points", "mass on a spring", "constraint spring", f"{MASS}::test_position_force_is_a_spring", GUIDES, "guided",
          "spring:drag_linear"),
    Entry("Guided points", "rotation about an axis", "constraint axis", f"{MASS}::test_drag_has_closed_forms", GUIDES, "guided",
          "axis:drag_linear"),
    Entry("Guided points", "rolling", "constraint plane", f"{GUIDED}::test_friction_in_a_bounce_slides_or_rolls", GUIDES, "guided",
          "plane:drag_linear"),
    Entry("Guided points", "dry friction", "dry_friction",
          f"{GUIDED}::test_dry_friction_takes_the_same_from_each_swing_and_ends_the_motion", GUIDES, "guided", "pendulum:dry_friction"),
    Entry("Guided points", "quadratic damping", "drag_quadratic", f"{MASS}::test_drag_has_closed_forms",
          "physics/effects/test_parameters.py::test_gradient_of_each_parameter_equals_finite_differences", "guided",
          "pendulum:drag_quadratic"),
    Entry("Guided points", "linear damping", "drag_linear", f"{MASS}::test_drag_has_closed_forms",
          "physics/effects/test_parameters.py::test_gradient_of_each_parameter_equals_finite_differences", "guided", "spring:drag_linear"),
    Entry("Guided points", "magnet by its place", "local_force", f"{GUIDED}::test_a_force_near_a_place_has_a_potential",
          f"{GUIDED}::test_slopes_of_lift_force_near_a_place_and_buoyancy_are_those_of_the_closed_forms", "guided", "spring:local_force"),
    Entry("Flight", "disc, lift and drag with angle", "lift", f"{GUIDED}::test_the_lift_of_a_disc_turns_the_path_and_keeps_the_speed",
          f"{GUIDED}::test_slopes_of_lift_force_near_a_place_and_buoyancy_are_those_of_the_closed_forms", "guided", "disc:lift"),
    Entry("Flight", "buoyancy and added mass", "buoyancy",
          f"{GUIDED}::test_slopes_of_lift_force_near_a_place_and_buoyancy_are_those_of_the_closed_forms",
          f"{GUIDED}::test_slopes_of_lift_force_near_a_place_and_buoyancy_are_those_of_the_closed_forms", "guided", "water:buoyancy"),
    Entry("Flight", "bounce, restitution", "constraint bounce",
          f"{GUIDED}::test_each_bounce_returns_its_share_of_the_speed_until_the_body_rests", GUIDES, "guided", "bounce:drag_quadratic"),
    Entry("Flight", "bounce, friction with spin", "bounce_friction", f"{GUIDED}::test_friction_in_a_bounce_slides_or_rolls",
          f"{GUIDED}::test_slopes_of_a_bounce_are_those_of_the_closed_forms", "guided", "bounce:bounce_friction"),
    Entry("Flight", "bounce, restitution by speed", "bounce_speed",
          f"{GUIDED}::test_each_bounce_returns_its_share_of_the_speed_until_the_body_rests",
          f"{GUIDED}::test_slopes_of_a_bounce_are_those_of_the_closed_forms", "guided", "bounce:bounce_speed"),
    Entry("Kinds of test", "stress prescribed", "control: stress", f"{LAW}::test_a_prescribed_stress_gives_back_the_strain", SLOPES,
          "creep_test", "creep"),
    Entry("Kinds of test", "small oscillation", "mode: oscillation", f"{LAW}::test_small_oscillations_give_the_complex_modulus",
          f"{LAW}::test_slopes_of_the_moduli_by_a_spectrum", "oscillation", "relaxation_spectrum"),
    Entry("Kinds of test", "flow curve", "mode: flow_curve", f"{FLOW}::test_newton", FLOWS, "fluid_curves", "power_law"),
    Entry("Kinds of test", "relaxation after a ramp", "time", f"{LAW}::test_a_spectrum_and_a_power_law_relax_as_their_closed_forms",
          SLOPES, "held_ramps", "fractional"),
    Entry("Kinds of test", "cycles in a periodic state", "periodic",
          f"{KINDS_OF_TEST}::test_a_periodic_state_is_that_of_the_last_of_many_cycles", SLOPES, "periodic_cycles", "viscosity_shear"),
    Entry("Kinds of test", "specimens as repeats", "repeats", f"{KINDS_OF_TEST}::test_repeats_give_the_scatter_of_specimens", SLOPES,
          "repeated_specimens", "strain_stiffening"),
    Entry("Kinds of test", "plane specimen, full field and force", "plane.yaml", f"{PLANE}::test_a_plate_with_a_hole_of_known_truth",
          f"{PLANE}::test_gradients_are_those_of_finite_differences", MADE_PLATES),
    Entry("Deforming bodies", "moving clamp", "clamps.motion", f"{GRIPS}::test_a_pull_sends_a_wave",
          f"{GRIPS}::test_gradients_of_reaction_and_motion", "driven", "viscosity_shear"),
    Entry("Deforming bodies", "measured force", "clamps.force", f"{GRIPS}::test_a_slow_pull_ends_in_the_static_stretch",
          f"{GRIPS}::test_gradients_of_reaction_and_motion", "driven", "strain_stiffening"),
)  # fmt: skip


INTRODUCTION = """# Diagnosis: what laboratories measure, key by key

Each effect and kind of data that a laboratory needs, with the test that holds its closed form or a refined computation, the test of its
derivatives (of points and flow curves: of the slopes that a fit takes by differences), and the made cases of `neuido undeclared` or, of
kinds of test, the form of `neuido/data/undeclared/laboratory_tests.py` that draws them. `tests/discrepancy/test_library_coverage.py` holds
that all of them exist.

"""


def page() -> str:
    """Return the table with its heading, as Markdown."""
    lines = ["| group | what | in the library | closed form or refined computation | gradient or slopes | made cases |", "| --- " * 6 + "|"]
    for own in ENTRIES:
        case = own.measured if "::" in own.measured else f"{own.measured}, {own.kind}"
        cells = [own.group, own.what, own.name, *(_short(test) for test in (own.closed, own.gradient)), _short(case)]
        lines.append("| " + " | ".join(cells) + " |")
    return INTRODUCTION + "\n".join(lines) + "\n"


def _short(test: str) -> str:
    """Return a test with its file's name alone."""
    return test.rpartition("/")[2].replace("::test_", ": ").replace("_", " ").replace(".py", "").replace("test ", "", 1)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Write the table of what laboratories measure, with the tests of each entry.")
    parser.add_argument("--out", type=Path, required=True)
    write_text(parser.parse_args().out, page())

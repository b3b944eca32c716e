"""relit inspect-board, inspect-paste, gauge-board and board-capability: what is wrong with a board, how well inspections repeat, and how
well boards keep to their limits."""

from typing import TYPE_CHECKING

import typer

from service.cli.printing import print_lines
from service.cli.request_commands import product_command
from service.requests.inspect_board import BoardCapabilityRequest, GaugeBoardRequest, InspectBoardRequest, InspectPasteRequest

if TYPE_CHECKING:
    from service.boards.board_capability import BoardCapabilityResult
    from service.boards.gauge_board import GaugeBoardResult
    from service.boards.inspect_board import InspectBoardResult
    from service.boards.inspect_paste import InspectPasteResult

MOST_PRINTED = 10
"""Findings that are printed; the table has all."""


def register(app: typer.Typer) -> None:
    """Add the commands."""
    product_command(app, "inspect-board", InspectBoardRequest, "service.boards.inspect_board:inspect_board", _inspect_board)
    product_command(app, "inspect-paste", InspectPasteRequest, "service.boards.inspect_paste:inspect_paste", _inspect_paste)
    product_command(app, "gauge-board", GaugeBoardRequest, "service.boards.gauge_board:gauge_board", _gauge_board)
    product_command(app, "board-capability", BoardCapabilityRequest, "service.boards.board_capability:board_capability", _board_capability)


def _inspect_board(result: "InspectBoardResult") -> bool:
    print_lines(height=result.board_path, picture=result.picture_path, report=result.report_path)
    if result.findings_path is not None and result.verdict is not None and result.inspected is not None:
        print(f"findings {result.findings_path}")
        for defect in result.defects[:MOST_PRINTED]:
            area = defect.area
            print(f"defect   at ({1e3 * area.x_m:.4f}, {1e3 * area.y_m:.4f}) mm, {1e3 * area.width_m:.3f} x {1e3 * area.height_m:.3f} mm: "
                  f"{1e6 * defect.deviation_m:+.3f} ± {1e6 * defect.sigma_m:.3f} µm, {defect.significance:.1f} σ")
        if len(result.defects) > MOST_PRINTED:
            print(f"defects  {len(result.defects) - MOST_PRINTED} more are in the table")
        wrong = [each for each in result.regions if each.verdict != "pass"]
        for each in wrong[:MOST_PRINTED]:
            measured = "" if each.deviation_m is None else f" {1e6 * each.deviation_m:+.3f} ± {1e6 * (each.sigma_m or 0):.3f} µm"
            print(f"region   {each.region.name}: {each.verdict}{measured}")
        if len(wrong) > MOST_PRINTED:
            print(f"regions  {len(wrong) - MOST_PRINTED} more that did not pass are in the table")
        print(f"verdict  {result.verdict}, {100 * result.inspected:.2f} % inspected")
    return result.verdict in (None, "pass")


def _inspect_paste(result: "InspectPasteResult") -> bool:
    print_lines(height=result.board_path, picture=result.picture_path, report=result.report_path, pads=result.pads_path)
    wrong = [each for each in result.pads if each.verdict not in (None, "pass") or each.bridged]
    for each in wrong[:MOST_PRINTED]:
        said = ", ".join(f"{name.removesuffix('_percent').replace('_', ' ')} {value:.1f} ± {sigma:.1f} %" for name, (value, sigma) in
                         each.values.items())
        connected = f", connected to {' '.join(each.bridged)}" if each.bridged else ""
        print(f"pad      {each.name}: {each.verdict or 'not judged'}: {said or 'not measured'}{connected}")
    if len(wrong) > MOST_PRINTED:
        print(f"pads     {len(wrong) - MOST_PRINTED} more that did not pass are in the table")
    print(f"verdict  {result.verdict or 'none, without limits'}, {len(result.pads)} pads")
    return result.verdict in (None, "pass")


def _board_capability(result: "BoardCapabilityResult") -> None:
    print_lines(table=result.table_path, report=result.report_path)
    for each in result.found[:MOST_PRINTED]:
        print(f"capable  {each.name} {each.quantity.replace('_', ' ')}: Cpk {each.cpk:.2f} (95 % sure: {each.cpk_bound:.2f}), "
              f"Cp {each.cp:.2f}, {each.boards} boards")
    if result.left_out:
        print(f"left out {len(result.left_out)} that too few boards have or that do not vary: {', '.join(result.left_out[:5])}")


def _gauge_board(result: "GaugeBoardResult") -> None:
    study = result.study
    print_lines(table=result.table_path, report=result.report_path)
    print(f"repeat   {1e6 * study.repeatability:.4g} µm (95 % sure: below {1e6 * study.repeatability_bound:.4g}), "
          f"{study.degrees_of_freedom} degrees of freedom; the inspections state {1e6 * result.noise_m:.4g} µm")
    print("operator not measured: there is one" if study.reproducibility is None else f"operator {1e6 * study.reproducibility:.4g} µm")
    print(f"gauge    {1e6 * study.gauge:.4g} µm: {study.gauge_percent:.3g} % of the variation of {result.parts} parts, "
          f"{result.tolerance_percent:.3g} % of the narrowest tolerance (6 σ)")
    print(f"sure     95 %: gauge below {1e6 * study.gauge_bound:.4g} µm, {study.gauge_percent_bound:.3g} % of the variation and "
          f"{result.tolerance_percent_bound:.3g} % of the tolerance" + (", without operators" if study.reproducibility is None else ""))
    if result.left_out:
        print(f"left out {len(result.left_out)} regions that not every run measured: {', '.join(result.left_out[:5])}")

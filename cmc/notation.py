"""The notation of the course as data: symbol, name in code, where it is, shape, unit, equation.

Shapes leave out leading batch axes. The paper uses A, B, K_1, K_2 and f twice; here every name has
one meaning. A test resolves every `where` in the code and every equation label in the paper's list.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Symbol:
    """One row of the notation table.

    Attributes:
        symbol: LaTeX, without dollar signs.
        name: name in the code.
        where: where that name is: a dotted path; `path(argument)` for an argument of a function.
        shape: shape without batch axes.
        unit: unit; `plant` where the plant's own units count, `1` for a pure number.
        equation: label in the paper; empty for what the paper does not have.
        meaning: a few plain words.
    """

    symbol: str
    name: str
    where: str
    shape: str
    unit: str
    equation: str
    meaning: str


_PLANT = "cmc.plants.base.Plant"
_SPACE = "cmc.theory.auxiliary.AuxiliarySpace"
_DIFF = "cmc.theory.differential"
_COMPOSITE = "cmc.theory.composite.CompositeModel"
_PEG = "cmc.plants.peg.Peg"

SIGNALS = (
    Symbol("y", "y", f"{_PLANT}.f(y)", "n", "plant", "y_and_g", "latent signal"),
    Symbol("u", "u", f"{_PLANT}.f(u)", "n", "plant", "theta_m", "command"),
    Symbol("z = T_y y", "z", f"{_SPACE}.to_z", "n", "plant", "theta_m", "auxiliary signal"),
    Symbol(
        "a = T_a^{-1} u", "a", f"{_SPACE}.to_u(a)", "n", "plant", "theta_m", "auxiliary command"
    ),
    Symbol(
        r"s_i = (z_i, \int z_i)",
        "s",
        "cmc.policies.networks.PositiveNetwork.forward(s)",
        "n, 2",
        "plant, plant s",
        "v",
        "what network i sees; I_k = I_{k-1} + h z_k when sampled",
    ),
    Symbol("h", "h", "cmc.theory.sampled.sampled_matrix(h)", "1", "s", "", "time between commands"),
)
"""What flows through the loop."""

DYNAMICS = (
    Symbol("f", "f", f"{_PLANT}.f", "n", "plant/s", "y_and_g", "latent dynamics"),
    Symbol(
        r"\partial f/\partial y", "f_y", f"{_PLANT}.f_y", "n, n", "1/s", "e", "its state Jacobian"
    ),
    Symbol(
        r"\partial f/\partial u", "f_u", f"{_PLANT}.f_u", "n, n", "1/s", "e", "its input Jacobian"
    ),
    Symbol(
        "T_y", "T_y", f"{_SPACE}.T_y", "n, n", "1", "theta_m", "V^-1, V the eigenvectors of f_y"
    ),
    Symbol("T_a", "T_a", f"{_SPACE}.T_a", "n, n", "1", "theta_m", "orthogonal, makes R triangular"),
    Symbol(
        r"\Theta_M",
        "Theta_M",
        f"{_DIFF}.Theta_M",
        "2n, 2n",
        "1",
        "theta_m",
        "both transforms in one matrix",
    ),
    Symbol(
        r"\Lambda = T_y f_y T_y^{-1}",
        "Lambda",
        f"{_SPACE}.Lambda",
        "n, n",
        "1/s",
        "eq_theorem2",
        "open-loop rates, diagonal, slowest first",
    ),
    Symbol(
        "R = T_y f_u T_a",
        "R",
        f"{_SPACE}.R",
        "n, n",
        "1/s",
        "eq_theorem2",
        "input gains, upper triangular",
    ),
)
"""The plant and the space it is decomposed in."""

CONTRACTION = (
    Symbol(
        r"\partial\pi_i/\partial s_{ij}",
        "slopes",
        f"{_DIFF}.blocks(slopes)",
        "n, 2",
        "1, 1/s",
        "v",
        "signed slopes of the networks, opposite to the sign of R_ii",
    ),
    *(
        Symbol(
            letter,
            f"{letter}_blk",
            f"{_DIFF}.Blocks.{letter}_blk",
            "n, n",
            unit,
            "inverse_solution",
            meaning,
        )
        for letter, unit, meaning in (
            ("A", "1/s", "z to z'"),
            ("B", "1/s", "a to z'"),
            ("C", "1/s", "z to a'"),
            ("D", "1/s", "a to a'"),
        )
    ),
    Symbol("F", "F", f"{_DIFF}.F", "2n, 2n", "1/s", "F", "differential dynamics of (z, a)"),
    Symbol("F_1", "F1", f"{_DIFF}.F1", "2n, 2n", "1/s", "F1", "F with T_y at rest"),
    Symbol("F_2", "F2", f"{_DIFF}.F2", "2n, 2n", "1/s", "F2", "what a moving T_y adds"),
    Symbol(
        "F_{ij}",
        "subsystems",
        f"{_DIFF}.subsystems",
        "n, n, 2, 2",
        "1/s",
        "deconstruction_explicit",
        "F regrouped: how (z_j, a_j) drives (z_i, a_i)",
    ),
    Symbol(
        r"\beta",
        "theorem1_margin",
        "cmc.theory.margins.theorem1_margin",
        "1",
        "1/s",
        "F1_theorem1",
        "margin of theorem 1",
    ),
    Symbol(
        r"\alpha",
        "theorem2_margin",
        "cmc.theory.margins.theorem2_margin",
        "n, 2",
        "1/s",
        "eq_theorem2",
        "margin of theorem 2",
    ),
    Symbol(
        "J",
        "loop_jacobian",
        "cmc.theory.certificates.loop_jacobian",
        "2n, 2n",
        "1/s",
        "",
        r"exact Jacobian in (z, int z)",
    ),
    Symbol(
        "M",
        "metric",
        "cmc.theory.certificates.Certificate.metric",
        "2n, 2n",
        "1",
        "",
        "metric in which distances shrink",
    ),
    Symbol(
        r"\beta",
        "rate",
        "cmc.theory.certificates.Certificate.rate",
        "1",
        "1/s",
        "xi",
        "rate at which they do",
    ),
    Symbol(
        "d",
        "size",
        "cmc.theory.robustness.ErrorBall.radius(size)",
        "1",
        "plant/s",
        "fd",
        "largest disturbance",
    ),
)
"""What is proved about the loop."""

COMPOSITE = (
    Symbol("K_p", "K_p", f"{_COMPOSITE}.K_p", "axes", "1/s²", "2nd_sys", "stiffness gain"),
    Symbol("K_d", "K_d", f"{_COMPOSITE}.K_d", "axes", "1/s", "2nd_sys", "damping gain"),
    Symbol(
        r"\Lambda_d", "lambda_d", f"{_COMPOSITE}.lambda_d", "axes", "1", "2nd_sys", "inertia factor"
    ),
    Symbol("K_1", "K1", f"{_COMPOSITE}.K1", "axes", "1/s²", "mapping_pos", "weight of the error"),
    Symbol("K_2", "K2", f"{_COMPOSITE}.K2", "axes", "1/s", "mapping_pos", "weight of its velocity"),
    Symbol("A", "A_lat", f"{_COMPOSITE}.A_lat", "axes", "s", "LTI", "latent model: factor of y'"),
    Symbol("B", "B_lat", f"{_COMPOSITE}.B_lat", "axes", "1", "LTI", "latent model: factor of y"),
)
"""Composite signals y = K1 e + K2 e' (e is the error of a pose; their units follow from it)."""

PEG = (
    Symbol(r"\tau_x", "tau_x", f"{_PEG}(tau_x)", "1", "s", "PPO", "lag along the surface"),
    Symbol(r"\tau_z", "tau_z", f"{_PEG}(tau_z)", "1", "s", "PPO", "lag across the surface"),
    Symbol("K_{sur}", "K_sur", f"{_PEG}(K_sur)", "1", "force/length", "PPO", "stiffness"),
    Symbol("K_1", "surface_sin", f"{_PEG}(surface_sin)", "1", "length", "PPO", "surface: sin x"),
    Symbol("K_2", "surface_cos", f"{_PEG}(surface_cos)", "1", "length", "PPO", "surface: cos x"),
    Symbol("g", "surface", f"{_PEG}.surface", "1", "length", "PPO", "height of the surface"),
    Symbol("f", "contact_force", f"{_PEG}.contact_force", "1", "force", "PPO", "never positive"),
)
"""The peg that touches a surface (the paper gives lengths and forces no units)."""

SECTIONS = {
    "Signals": SIGNALS,
    "Plant and auxiliary space": DYNAMICS,
    "Contraction": CONTRACTION,
    "Composite signals": COMPOSITE,
    "Peg": PEG,
}
"""All symbols by section, in the order of the table."""


class Table(str):
    """Markdown text that a notebook renders."""

    __slots__ = ()

    def _repr_markdown_(self) -> str:
        return str(self)


def table(*sections: str) -> Table:
    """Return the notation as a Markdown table that a notebook renders.

    Args:
        sections: names in `SECTIONS`; all of them by default.

    Raises:
        ValueError: if there is no such section.
    """
    unknown = set(sections) - set(SECTIONS)
    if unknown:
        raise ValueError(f"no section {sorted(unknown)}; there are: {list(SECTIONS)}")
    rows = ["| symbol | in code | shape | unit | equation | meaning |", "|---|---|---|---|---|---|"]
    for section in sections or SECTIONS:
        rows.append(f"| **{section}** | | | | | |")
        for s in SECTIONS[section]:
            label = f"`{s.equation}`" if s.equation else "ours"
            shape = "scalar" if s.shape == "1" else f"({s.shape})"
            rows.append(
                f"| ${s.symbol}$ | `{s.name}` | {shape} | {s.unit} | {label} | {s.meaning} |"
            )
    return Table("\n".join(rows))

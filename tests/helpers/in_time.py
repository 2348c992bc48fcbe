"""Tables [time] of all integrators."""

SCHEMES = {
    "central_differences": {},
    "chung_lee": {},
    "souza_moura": {},
    "hulbert_chung": {"rho_b": 0.8},
    "newmark": {"beta": 0.25, "gamma": 0.5},
    "wilson": {},
    "houbolt": {},
    "generalized_alpha": {"rho_inf": 0.6},
    "energy_momentum": {},
}


def in_time(scheme, mass="lumped", step=1e-4, end=3e-3):
    """Tables of a run with an integrator."""
    return {"time": {"integrator": scheme, "step": step, "end": end, "mass": mass, **SCHEMES[scheme]}}

# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # From a model to a guarantee
# An estimate without an error bound is a hope. Here three plants go all the way: from equations and a domain to a
# certificate of detectability, from there to a horizon and a longest wait, and to a bound that every estimate carries
# and that the true error is held against. How to read a certificate: `docs/certificates.md`; what the bounds are:
# `docs/guarantees.md`.

# %%
import matplotlib.pyplot as plt
import numpy as np

from ctmhe import (
    MHE,
    RK4,
    Certified,
    DiscountedCost,
    Guarantee,
    Innovation,
    Network,
    OdePlant,
    Periodic,
    SendOnDelta,
    Uniform,
    WholeSignal,
    simulate,
)
from ctmhe.certificates import certify_detectability
from ctmhe.models.library import batch_reactor, chua_discrete, quadrotor
from ctmhe.models.library.quadrotor import hover_speed
from ctmhe.simulation.audit import audit

# %% [markdown]
# ## The batch reactor
# Two gases, one pressure gauge (thesis 3.4.1). The Jacobian depends on pA alone and is affine in it, so that two
# vertices cover the whole domain, and the certificate is a proof.

# %%
reactor = batch_reactor()
certificate = certify_detectability(reactor, eta=0.4, objective="P", Q=[1e3, 1e3, 1e2], R=1e2)
print(f"covered by {certificate.method}: {'a proof' if certificate.rigorous else 'evidence'}")
print(f"the horizon has to exceed {certificate.shortest_horizon():.2f} s plus the longest wait")
print(f"with a horizon of 2 s waits stay below {certificate.longest_wait(2.0):.3f} s")

# %% [markdown]
# The estimator takes its weights from the certificate, and the trigger its longest wait. Disturbances are bounded by
# 1e-3; holding the output for 0.01 s adds up to 0.015 bar to the noise, since it moves by 1.5 bar/s at first.

# %%
mhe = MHE(
    reactor,
    horizon=2.0,
    interval=0.01,
    integrator=RK4(0.01),
    cost=DiscountedCost.from_certificate(certificate),
    bounds=reactor.bounds,
    hold="zero",
    guarantee=Guarantee(certificate, {"w_pA": 1e-3, "w_pB": 1e-3, "v_pressure": 0.016}),
)
policy = Certified(SendOnDelta(0.1), certificate, horizon=2.0)
run = simulate(
    reactor,
    mhe,
    trigger=policy,
    until=6.0,
    guess=[0.1, 4.5],
    truth=[3.0, 1.0],
    disturbance=Uniform(1e-3, interval=0.01),
)
print(run)
print("\nWhat Theorem 3.1 needs:", *policy.conditions, sep="\n- ")

# %%
run.plot_bounds()
plt.show()

# %% [markdown]
# The theorem's bound stays above the width of the domain, and so says nothing; that of the windows, which uses the
# costs that the solver found, gets below it within a horizon. Both are far above the true error: theory pays a factor
# of four for each window and knows disturbances by their bound only, and P has a condition number of 5000, which makes
# an error along (1, -1) nearly invisible to this norm.
#
# Is such a bound worth anything? Something has to break it, and does: the open loop from the wrong guess, and the
# guess itself.

# %%
start = mhe.init(x=[0.1, 4.5])
controls = {
    "estimates": None,
    "open loop": lambda times: np.array([mhe.predict(start, float(t)).x for t in times]),
    "constant guess": lambda times: np.tile([0.1, 4.5], (len(times), 1)),
}
figure, axes = plt.subplots(figsize=(7.2, 3.2), layout="constrained")
for (name, candidate), style in zip(controls.items(), ("o-", "s--", "^:"), strict=True):
    found = audit(run, reactor, certificate, candidate=candidate)
    axes.semilogy(found.t, found.theorem_ratio, style, markersize=3, label=name)
axes.axhline(1.0, color="black", linewidth=0.8)
axes.set(xlabel="time [s]", ylabel="left / right side of (3.32)", title="Above one, the bound is broken")
axes.legend()
plt.show()

# %% [markdown]
# ## The Chua circuit
# Chaotic, discrete in time, with a cubic: its Jacobian is a polynomial of degree two, whose Bernstein coefficients span
# a hull of all its values. Again a proof. Equal gaps that divide the horizon would need no wait at all (Remark 3.7);
# here an innovation trigger decides.

# %%
circuit = chua_discrete()
chaotic = certify_detectability(circuit, eta=0.93)
print(f"{chaotic.method}, proof: {chaotic.rigorous}; horizon above {chaotic.shortest_horizon():.1f} steps")
watching = MHE(
    circuit,
    horizon=0.8,
    cost=DiscountedCost.from_certificate(chaotic),
    bounds=circuit.bounds,
    guarantee=Guarantee(chaotic, {"w_x1": 1e-4, "w_x2": 1e-4, "w_x3": 1e-4, "v_voltage": 1e-3}),
)
swing = simulate(
    circuit,
    watching,
    trigger=Certified(Innovation(0.02), chaotic, horizon=0.8),
    until=3.0,
    guess=[-1.0, 0.5, 1.0],
    truth=[1.0, 0.0, -1.0],
    disturbance=Uniform(1e-4, interval=0.01),
)
print(swing)
swing.plot_bounds()
plt.show()

# %% [markdown]
# ## The quadrotor
# Twelve states, four rotors, sines and tangents. The thesis certifies its Euler discretisation on a grid and leaves the
# continuous-time one out. Positions and velocities are unbounded: no Jacobian depends on them.

# %%
flyer = quadrotor()
hover = hover_speed()
flying = certify_detectability(flyer, u=(0.98 * hover, 1.02 * hover), eta=0.1)
print(f"{flying.method}, {'proof' if flying.rigorous else 'evidence'}; horizon above {flying.shortest_horizon():.2f} s")
for note in flying.notes:
    print("-", note)

# %% [markdown]
# A domain that the plant can leave is no obstacle to the certificate, which speaks of trajectories while they stay
# inside; that they do is ours to see to. Here small inputs sway the machine for three seconds. Disturbances are within
# 1e-3 and noise within 0.01; holding a record for 0.01 s adds the speed, up to 1.5 m/s, times that. The initial error
# is known up to its sign: `error=`.

# %%
wrong = np.array([0.3, -0.3, 0.2, 0.05, -0.05, 0.05, 0.3, 0.3, -0.2, 0.05, 0.05, 0.05])
truth = np.array([0, 0, 0, 0.05, 0, 0, 0.4, -0.2, 0, 0, 0, 0])
process = [name for name in flyer.w if name.startswith("w_")]
noise = [name for name in flyer.w if name.startswith("v_")]
pilot = MHE(
    flyer,
    horizon=1.5,
    interval=0.05,
    integrator=RK4(0.05),
    cost=DiscountedCost.from_certificate(flying),
    bounds=flyer.bounds,
    hold="zero",
    guarantee=Guarantee(flying, dict.fromkeys(process, 1e-3) | dict.fromkeys(noise, 0.025), error=np.abs(wrong)),
)


def rotors(t):
    """Sway about roll and pitch."""
    return hover * (1 + 1e-4 * np.array([np.sin(4 * t), np.cos(3 * t), -np.sin(4 * t), -np.cos(3 * t)]))


flight = simulate(
    OdePlant(flyer),
    pilot,
    trigger=Certified(Periodic(0.1), flying, horizon=1.5),
    until=3.0,
    guess=truth + wrong,
    truth=truth,
    inputs=rotors,
    disturbance=dict.fromkeys(process, Uniform(1e-3, interval=0.05))
    | dict.fromkeys(noise, Uniform(0.01, interval=0.05)),
)
print(flight)
largest = np.abs(flight.dataset["x_true"]).max("time").to_pandas().round(2)
print("largest on the way:", largest.to_dict())

# %%
flight.plot_bounds()
plt.show()

# %% [markdown]
# Equal gaps that divide the horizon: by Remark 3.7 the theorem has a factor of 4 in place of 8. P is at least one
# here, so the number on the axis bounds the error of every state in its own unit, and `Estimate.bound.radii` is
# smaller where P is larger. Forget the channel's promise, and the bound is gone, with a reason:

# %%
lossy = simulate(
    OdePlant(flyer),
    pilot,
    trigger=Certified(Periodic(0.1), flying, horizon=1.5),
    until=2.0,
    guess=truth + wrong,
    truth=truth,
    inputs=rotors,
    channel=Network(WholeSignal(), loss=0.15),
    seed=1,
)
print(lossy.messages_lost, "messages lost;", next((text for text in lossy.uncertified if text), "none mattered"))

# %% [markdown]
# ## What was needed
# A model, a box in which it stays, and a bound of its disturbances. The rest follows: the Jacobians and a hull of them,
# the matrix inequality and its solution, weights, horizon, longest wait, bounds. Where the hull is only a grid, the
# certificate says so; where the channel loses data, the run does.

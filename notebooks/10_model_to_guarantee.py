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
    Bounds,
    Certified,
    DiscountedCost,
    Guarantee,
    Innovation,
    OdePlant,
    Periodic,
    SendOnDelta,
    Uniform,
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
# The theorem's bound starts above the width of the domain and so says nothing yet; that of the windows, which uses the
# costs that the solver found, gets below it within a horizon. Both are far above the true error. The distance has
# reasons: a factor of four, an eta that is slow so that the horizon may be short, and a matrix P with a condition number
# of 5000, which makes an error along (1, -1) nearly invisible to this norm.
#
# Is the bound worth anything then? Something has to break it, and does: the open loop from the wrong guess, and the guess.

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
flying = certify_detectability(flyer, u=(0.9 * hover, 1.1 * hover), eta=0.1)
print(f"{flying.method}, {'proof' if flying.rigorous else 'evidence'}; horizon above {flying.shortest_horizon():.2f} s")
for note in flying.notes:
    print("-", note)

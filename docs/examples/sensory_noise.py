"""
Motor noise inside the loop
===========================

A muscle adds noise to its command, the body moves, and the subject responds to this motion too.

.. image:: images/sphx_glr_sensory_noise_001.png
   :alt: the same subject and push with and without motor noise

Least squares attributes everything it does not explain to the recorder. Here a simulated subject
holds a cart in place with a noisy hand, and is fitted by least squares and by maximum likelihood.
"""

# %%
# **The subject.** A cart of 1 kg is pushed by a force that takes three values for half a second
# each. The hand gives at most 0.7 N, with motor noise of 0.4 N. The subject senses the state
# exactly; the recorder has noise of 2 mm.
import control
import matplotlib.pyplot as plt
import numpy as np
from terminal import RESULTS, show

import impc
from impc.assess.covariance import gain_covariance
from impc.output_feedback.intervals import level_intervals, person_covariance
from impc.output_feedback.simulation import simulate_person

system = control.ss(
    [[1, 0.05], [0, 0.98]],
    [[0, 0], [0.05, 0.05]],
    [[1, 0]],
    0,
    0.05,
    states=["place", "speed"],
    inputs=["force", "push"],
    outputs=["place"],
)
plant = impc.Plant(system, ["force"])
bounds = impc.Bounds(plant, u_min=-0.7, u_max=0.7)
truth = impc.Controller(plant, impc.Weights(np.diag([8.0, 1.0]), 1), bounds, 5, terminal_set=False)
person = impc.Observer(plant, motor=0.4)

rng = np.random.default_rng(1)
pushes = [np.repeat(rng.choice([-0.7, 0.0, 0.7], 60), 10) for _ in range(3)]
trials = [
    simulate_person(truth, person, push, recorder=0.002, seed=k) for k, push in enumerate(pushes)
]

# %%
# The same subject and push, with and without motor noise:
steady = simulate_person(truth, impc.Observer(plant), pushes[0])
time = 0.05 * np.arange(len(pushes[0]))
figure, axes = plt.subplots(figsize=(7, 3), layout="constrained")
axes.plot(time, 100 * trials[0].states[:, 0], label="as recorded")
axes.plot(time, 100 * steady.states[:, 0], label="without noise")
axes.set(xlabel="time (s)", ylabel="place (cm)")
axes.legend()
RESULTS.mkdir(exist_ok=True)
figure.savefig(RESULTS / "noisy-person.png")
show("noisy-person.png")
at_limit = np.mean([np.mean(np.abs(trial.u) >= 0.7 - 1e-9) for trial in trials])
print(f"at the limit: {100 * at_limit:.0f} % of the time")

# %%
# **Least squares** has a high VAF here. Its gain can still be biased, because noise inside the loop
# is not recorder noise.
recordings = [
    impc.Recording(plant, trial.outputs, push) for trial, push in zip(trials, pushes, strict=True)
]
problem = impc.Problem(plant, bounds, 5, recordings, terminal_set=False, unknown_start=True)
least = impc.fit(problem)
least_deviations = gain_covariance(
    least.problem, np.array(least.gain), np.array(least.metric), curvature=True
).entries

# %%
# **Maximum likelihood** estimates the gain, the motor noise and the recorder noise together. The
# motor noise starts at 0.1.
likely = impc.fit_output_feedback(least, impc.Observer(plant, motor=0.1))
covariance = person_covariance(likely)
print(f"converged: {likely.converged}")
for name, (low, high) in zip(likely.space.names, level_intervals(likely, covariance), strict=True):
    print(f"{name}: {low:.4f} to {high:.4f} (95 %)")

# %%
# Both gains with 95 % intervals, and the true gain:
figure, panels = plt.subplots(1, 2, figsize=(7, 3), layout="constrained")
for k, (panel, unit) in enumerate(zip(panels, ("N/m", "Ns/m"), strict=True)):
    values = [least.gain[0, k], likely.K[0, k]]
    deviations = [least_deviations[0, k], covariance.entries[0, k]]
    panel.errorbar([0, 1], values, 1.96 * np.array(deviations), fmt="o", capsize=4)
    panel.axhline(truth.K[0, k], color="black", linewidth=1, label="true gain")
    panel.set_xticks([0, 1], ["least squares", "likelihood"])
    panel.set(xlim=(-0.5, 1.5), title=f"gain on {plant.states[k]} ({unit})")
panels[0].legend(loc="lower center")
figure.savefig(RESULTS / "noisy-person-gain.png")
show("noisy-person-gain.png")
for name, gain in (("true gain", truth.K), ("least squares", least.gain), ("likelihood", likely.K)):
    print(f"{name:14s} {np.round(np.ravel(gain), 2)}")

# %%
# :doc:`/why/output_feedback` says how often such intervals cover the true gain, and when not to
# use them. In a configuration file, ``[fit.observer]`` requests this fit.

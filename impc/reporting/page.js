"use strict";
// Copy button, links into folded parts, sortable tables, moving body, interactive curves. The page works without scripts.
(() => {
  const all = (query, place = document) => [...place.querySelectorAll(query)];
  const make = (tag, place, words = "") => {
    const one = document.createElement(tag);
    one.textContent = words;
    place.append(one);
    return one;
  };
  document.documentElement.classList.add("js");
  document.addEventListener("keydown", (one) => {
    if (one.key === "Escape" && document.activeElement.matches(".term")) document.activeElement.blur();
  });

  const unfold = () => {
    let at = document.getElementById(decodeURIComponent(location.hash.slice(1)));
    for (; at; at = at.parentElement) if (at.tagName === "DETAILS") at.open = true;
  };
  addEventListener("hashchange", unfold);
  unfold();

  for (const button of all("[data-copy]")) {
    const words = document.getElementById(button.dataset.copy);
    const said = document.getElementById("said");
    const select = () => {
      getSelection().selectAllChildren(words);
      said.textContent = "The text is selected: press Ctrl+C";
    };
    button.addEventListener("click", () => {
      const text = [...words.children].map((one) => one.textContent.replace(/[ \t\n]+/g, " ").trim()).join("\n\n");
      if (!navigator.clipboard) return select();
      navigator.clipboard.writeText(text).then(() => {
        said.textContent = button.textContent = "Copied";
      }, select);
    });
  }

  // Numbers by size; other cells after them in alphabetical order.
  const order = (one, other) => {
    const [a, b] = [one, other].map((text) => parseFloat(text.replace("\u2212", "-")));
    if (isNaN(a) !== isNaN(b)) return isNaN(a) ? 1 : -1;
    return isNaN(a) ? one.localeCompare(other) : a - b;
  };
  for (const table of all("table.sortable")) {
    const body = table.tBodies[0];
    if (body.rows.length < 3) continue;
    [...table.tHead.rows[0].cells].forEach((head, column) => {
      const words = head.textContent;
      head.textContent = "";
      const button = make("button", head, words);
      button.type = "button";
      button.title = "Sort";
      button.addEventListener("click", () => {
        const sign = head.ariaSort === "ascending" ? -1 : 1;
        for (const one of table.tHead.rows[0].cells) one.ariaSort = null;
        head.ariaSort = sign > 0 ? "ascending" : "descending";
        const text = (row) => row.cells[column].textContent.trim();
        body.append(...[...body.rows].sort((a, b) => sign * order(text(a), text(b))));
      });
    });
  }

  // Recorded and modelled body; between two frames the numbers of a path are interpolated.
  for (const place of all(".moving")) {
    const { start, step, frames, limit } = JSON.parse(place.querySelector("script").textContent);
    const [play, slow, slider, said] = all("button, input, .time", place);
    const paths = all(".scripted path", place);
    let [time, before] = [0, 0];
    const show = () => {
      const k = Math.floor(time / step + 1e-6), part = time / step - k;
      frames.forEach((each, who) => {
        const next = (each[k + 1] || each[k]).split(" ");
        paths[who].setAttribute("d", each[k].split(" ").map((one, i) => +one + part * (next[i] - one) || one).join(" "));
      });
      paths[1].classList.toggle("limit", limit[k]);
      slider.value = time;
      said.textContent = slider.ariaValueText = `${(start + time).toFixed(2)} s${limit[k] ? ", command at its limit" : ""}`;
      play.textContent = before ? "Pause" : "Play";
    };
    const move = (now) => {
      if (!before) return;
      // A first frame can have begun before the click.
      time = Math.min(time + Math.max(now - before, 0) / (slow.checked ? 4000 : 1000), slider.max);
      before = time < slider.max && now;
      show();
      requestAnimationFrame(move);
    };
    play.addEventListener("click", () => {
      before = before ? 0 : performance.now();
      if (time >= slider.max) time = 0;
      requestAnimationFrame(before ? move : show);
    });
    slider.addEventListener("input", () => {
      [time, before] = [slider.valueAsNumber, 0];
      show();
    });
    [slider.step, slider.max] = [step, step * (limit.length - 1)];
    slow.checked = matchMedia("(prefers-reduced-motion: reduce)").matches;
    show();
  }

  // One panel per signal with a common time axis: drag to zoom, double-click to reset.
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const explore = (place) => {
    const data = JSON.parse(place.querySelector("script").textContent);
    const tools = make("p", place);
    tools.className = "tools";
    const choice = make("select", tools);
    choice.ariaLabel = "Trial";
    data.trials.forEach((trial, index) => (make("option", choice, trial.label).value = index));
    make("span", tools, "Drag to zoom, double-click for the whole trial; click a name to hide its curve.");
    const plots = make("div", place);
    const sync = uPlot.sync(place.dataset.title);
    const axis = { stroke: colour("--muted"), grid: { stroke: colour("--rule"), width: 1 } };
    let shown = [];
    const draw = () => {
      for (const one of shown) one.destroy();
      const trial = data.trials[choice.value];
      const time = trial.panels[0].curves[0].map((_, k) => k * trial.step);
      shown = trial.panels.map((panel) => {
        const series = panel.curves.map((_, k) => ({
          label: data.curves[k].label, stroke: colour(data.curves[k].color), width: k ? 1.5 : 3, dash: data.curves[k].dash, show: k < 2,
        }));
        const limits = panel.limits.map((one) => ({
          label: "limit", stroke: colour("--limit"), dash: [4, 3], width: 1, values: time.map(() => one),
        }));
        const options = {
          title: panel.label, width: plots.clientWidth || 600, height: 190, cursor: { sync: { key: sync.key, setSeries: true } },
          scales: { x: { time: false } }, axes: [axis, axis],
          series: [{ label: "time (s)" }, ...series, ...limits.map(({ values, ...rest }) => rest)],
          hooks: { setScale: [(one, key) => {
            if (key !== "x") return;
            const { min, max } = one.scales.x;
            for (const other of shown) if (other.scales.x.min !== min || other.scales.x.max !== max) other.setScale("x", { min, max });
          }] },
        };
        return new uPlot(options, [time, ...panel.curves, ...limits.map((one) => one.values)], plots);
      });
    };
    choice.addEventListener("change", draw);
    addEventListener("resize", () => { for (const one of shown) one.setSize({ width: plots.clientWidth, height: 190 }); });
    const fold = place.closest("details");
    if (fold && !fold.open) fold.addEventListener("toggle", draw, { once: true });
    else draw();
  };
  for (const place of all(".chart")) explore(place);
})();

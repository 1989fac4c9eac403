"use strict";
// What a reader may want to do with a page: open and fold, sort, move and zoom curves, switch them on and
// off, walk through other weights. Nothing is fetched, and without scripts the page is whole too.
(() => {
  const make = (tag, inside, place) => {
    const one = document.createElement(tag);
    one.textContent = inside;
    place.append(one);
    return one;
  };
  const press = (words, place, told) => {
    const one = make("button", words, place);
    one.type = "button";
    one.addEventListener("click", told);
    return one;
  };

  // Fold: what a link leads to is opened.
  const parts = [...document.querySelectorAll("details")];
  const unfold = () => {
    const target = document.getElementById(decodeURIComponent(location.hash.slice(1)));
    for (let at = target; at; at = at.parentElement) if (at.tagName === "DETAILS") at.open = true;
  };
  addEventListener("hashchange", unfold);
  unfold();
  const contents = document.querySelector("nav") || document.querySelector("header");
  if (contents && parts.length) {
    const all = press("Open all", contents, () => {
      const open = all.textContent === "Open all";
      for (const one of parts) one.open = open;
      all.textContent = open ? "Fold all" : "Open all";
    });
  }

  // Sort: numbers by size, what is no number after them by its letters.
  const value = (row, column) => row.cells[column].textContent.trim();
  const compare = (one, other) => {
    const [a, b] = [parseFloat(one), parseFloat(other)];
    if (isNaN(a) !== isNaN(b)) return isNaN(a) ? 1 : -1;
    return isNaN(a) ? one.localeCompare(other) : a - b;
  };
  for (const table of document.querySelectorAll("table.numbers")) {
    const body = table.tBodies[0];
    if (body.rows.length < 2) continue;
    [...table.tHead.rows[0].cells].forEach((head, column) => {
      const words = head.textContent;
      if (!words) return;
      head.textContent = "";
      press(words, head, () => {
        const sign = head.ariaSort === "ascending" ? -1 : 1;
        for (const one of table.tHead.rows[0].cells) one.ariaSort = null;
        head.ariaSort = sign > 0 ? "ascending" : "descending";
        const rows = [...body.rows];
        rows.sort((a, b) => sign * compare(value(a, column), value(b, column)));
        body.append(...rows);
      }).title = "Sort";
    });
  }

  // Curves: a panel a signal above each other, all over the same time.
  const [LEFT, RIGHT, GAP, HIGH] = [56, 8, 26, 120];
  // The name of SVG's space is an address: it is asked for, so that no page holds any.
  const space = new DOMParser().parseFromString("<svg></svg>", "text/html").body.firstChild.namespaceURI;
  const draw = (name, attributes, place, words) => {
    const one = document.createElementNS(space, name);
    for (const [key, given] of Object.entries(attributes)) one.setAttribute(key, given);
    if (words !== undefined) one.textContent = words;
    place.append(one);
    return one;
  };
  const ticks = (low, high, count) => {
    const raw = (high - low) / count;
    const power = 10 ** Math.floor(Math.log10(raw));
    const step = power * [1, 2, 5, 10].find((one) => one * power >= raw);
    const found = [];
    for (let k = Math.ceil(low / step); k * step <= high; k++) found.push(Number((k * step).toPrecision(12)));
    return found;
  };
  const range = (panel) => {
    const first = panel.curves.find((curve) => curve.some((one) => one !== null)) || [0];
    const ends = [...first.filter((one) => one !== null), ...panel.bounds];
    const [low, high] = [Math.min(...ends), Math.max(...ends)];
    const spare = 0.15 * (high - low || 1);
    return [low - spare, high + spare];
  };
  const chart = (holder) => {
    const data = JSON.parse(holder.textContent);
    const figure = holder.closest("figure");
    const place = make("div", "", figure);
    place.className = "chart";
    place.hidden = true;
    const count = data.panels[0].curves[0].length;
    const whole = [0, (count - 1) * data.step];
    let [view, at] = [whole, 0];
    const shown = data.curves.map(() => true);
    const opened = press(data.positions ? "Walk through the weights" : "Move, zoom, switch on and off", figure, () => {
      place.hidden = !place.hidden;
      figure.querySelector("img").hidden = !place.hidden;
      opened.ariaExpanded = String(!place.hidden);
      paint();
    });
    opened.ariaExpanded = "false";
    figure.querySelector("img").after(opened, place);
    const tools = make("p", "", place);
    tools.className = "tools";
    const look = (middle, width) => {
      const kept = Math.min(Math.max(width, 10 * data.step), whole[1]);
      const first = Math.min(Math.max(middle - kept / 2, 0), whole[1] - kept);
      view = [first, first + kept];
      paint();
    };
    const middle = () => (view[0] + view[1]) / 2;
    const width = () => view[1] - view[0];
    for (const [sign, words, told] of [
      ["\u2212", "Zoom out", () => look(middle(), 2 * width())],
      ["+", "Zoom in", () => look(middle(), width() / 2)],
      ["\u2190", "Earlier", () => look(middle() - width() / 3, width())],
      ["\u2192", "Later", () => look(middle() + width() / 3, width())],
      ["All", "Whole trial", () => look(whole[1] / 2, whole[1])],
    ]) press(sign, tools, told).ariaLabel = words;
    data.curves.forEach((curve, index) => {
      const label = make("label", "", tools);
      const box = make("input", "", label);
      box.type = "checkbox";
      box.checked = true;
      box.addEventListener("change", () => { shown[index] = box.checked; paint(); });
      const sample = draw("svg", { width: 26, height: 8, "aria-hidden": "true" }, label);
      draw("line", { x1: 0, x2: 26, y1: 4, y2: 4, stroke: curve.color, "stroke-width": 2, "stroke-dasharray": curve.dash }, sample);
      label.append(curve.label);
    });
    const prices = data.positions && make("div", "", place);
    if (data.positions) {
      const label = make("label", "Weights: ", tools);
      const slider = make("input", "", label);
      Object.assign(slider, { type: "range", min: 0, max: data.positions.length - 1, value: 0 });
      slider.addEventListener("input", () => { at = Number(slider.value); paint(); });
    }
    const paint = () => {
      for (const old of place.querySelectorAll(":scope > svg")) old.remove();
      if (place.hidden) return;
      if (prices) bars(prices, data, at);
      const wide = place.clientWidth;
      const tall = data.panels.length * (HIGH + GAP) + 24;
      const sheet = draw("svg", { width: wide, height: tall, role: "img", "aria-label": data.title }, place);
      const x = (time) => ((time - view[0]) / width()) * (wide - LEFT - RIGHT);
      data.panels.forEach((panel, row) => {
        const top = row * (HIGH + GAP) + GAP;
        const [low, high] = range(panel);
        const y = (one) => ((high - one) / (high - low)) * HIGH;
        draw("text", { x: 0, y: top - 8 }, sheet, panel.label);
        for (const one of ticks(low, high, 3)) {
          draw("text", { x: LEFT - 6, y: top + y(one) + 4, "text-anchor": "end" }, sheet, one);
          draw("line", { x1: LEFT, x2: wide - RIGHT, y1: top + y(one), y2: top + y(one), class: "grid" }, sheet);
        }
        const inner = draw("svg", { x: LEFT, y: top, width: wide - LEFT - RIGHT, height: HIGH }, sheet);
        for (const one of panel.bounds) draw("line", { x1: 0, x2: wide, y1: y(one), y2: y(one), class: "bound" }, inner);
        // What was recorded lies below all; the first of the others above all.
        [...panel.curves.keys()].sort((a, b) => (a && b ? b - a : a - b)).forEach((index) => {
          if (!shown[index]) return;
          const curve = panel.curves[index];
          const moved = data.positions && index === panel.curves.length - 1;
          const values = moved ? data.positions[at].panels[row] : curve;
          let path = "";
          let pen = "M";
          values.forEach((one, k) => {
            if (one === null) { pen = "M"; return; }
            path += `${pen}${x(k * data.step).toFixed(1)},${y(one).toFixed(1)}`;
            pen = "L";
          });
          const { color, dash } = data.curves[index];
          draw("path", { d: path, stroke: color, "stroke-dasharray": dash, "stroke-width": index ? 1.4 : 3, fill: "none" }, inner);
        });
      });
      for (const one of ticks(...view, wide < 500 ? 4 : 8)) {
        draw("text", { x: LEFT + x(one), y: tall - 8, "text-anchor": "middle" }, sheet, one);
      }
      draw("text", { x: 0, y: tall - 8 }, sheet, data.label);
    };
    addEventListener("resize", paint);
    let held = null;
    place.addEventListener("pointerdown", (one) => {
      if (one.target.closest("svg[role=img]")) held = { from: one.clientX, middle: middle() };
    });
    addEventListener("pointerup", () => { held = null; });
    addEventListener("pointermove", (one) => {
      if (!held) return;
      const share = (held.from - one.clientX) / (place.clientWidth - LEFT - RIGHT);
      look(held.middle + share * width(), width());
    });
  };
  const bars = (place, data, at) => {
    place.textContent = "";
    const told = data.positions[at];
    make("p", `${told.label} ${told.difference}`, place).setAttribute("aria-live", "polite");
    const all = data.positions.flatMap((one) => one.prices);
    const most = Math.log(Math.max(...all));
    const least = Math.max(Math.log(Math.min(...all)), most - 14);
    const bar = (name, shown, share) => {
      const row = make("p", "", place);
      row.className = "price";
      make("span", `${name} `, row);
      const length = make("meter", "", row);
      length.value = share;
      length.ariaLabel = name;
      make("span", shown.toPrecision(3), row);
    };
    data.prices.forEach((name, k) => {
      bar(name, told.prices[k], 0.02 + (0.98 * (Math.log(told.prices[k]) - least)) / (most - least || 1));
    });
    data.mixed.forEach((name, k) => bar(name, told.mixed[k], (1 + told.mixed[k]) / 2));
  };
  for (const holder of document.querySelectorAll("script.chart")) chart(holder);
})();

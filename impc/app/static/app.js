"use strict";
// Drop zone, plots with handles of the cut, and faults. Everything else is HTML and htmx.
(() => {
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const plots = (place) => {
    for (const one of place.querySelectorAll(".plot")) {
      if (one.querySelector(".uplot")) continue;
      const data = JSON.parse(one.querySelector("script").textContent);
      const axis = { stroke: colour("--muted"), grid: { stroke: colour("--rule"), width: 1 } };
      const size = () => ({ width: one.clientWidth || 600, height: 150 });
      const moved = [];
      const plot = new uPlot({
        ...size(), hooks: { draw: [() => { for (const one of moved) one(); }] }, scales: { x: { time: false } }, legend: { show: false }, cursor: { sync: { key: "all" } },
        axes: [{ ...axis, label: "s", labelSize: 18 }, { ...axis, size: 60, space: 16, label: one.dataset.unit, labelSize: 18 }], series: [{}, { stroke: colour("--accent"), width: 1 }],
      }, data, one);
      moved.push(...["start", "stop"].map((name) => cut(plot, data[0], name)));
      addEventListener("resize", () => plot.setSize(size()));
    }
  };
  // A handle at the begin or end of the trial: dragged, it writes the time into its field.
  const cut = (plot, time, name) => {
    const field = document.getElementById(name), handle = document.createElement("div");
    const edge = name === "start" ? time[0] : time[time.length - 1];
    const shown = () => { handle.style.left = `${plot.valToPos(parseFloat(field.value.replace(",", ".")) || edge, "x")}px`; };
    handle.className = `cut ${name}`;
    handle.title = name === "start" ? "Drag to where the trial begins" : "Drag to where the trial ends";
    handle.addEventListener("mousedown", (one) => one.stopPropagation()); // no zoom
    handle.addEventListener("pointerdown", (one) => { one.stopPropagation(); handle.setPointerCapture(one.pointerId); });
    handle.addEventListener("pointermove", (one) => {
      if (!handle.hasPointerCapture(one.pointerId)) return;
      const at = plot.posToVal(one.clientX - plot.over.getBoundingClientRect().left, "x");
      field.value = Math.min(Math.max(at, time[0]), time[time.length - 1]).toFixed(2);
      shown();
    });
    handle.addEventListener("pointerup", () => field.dispatchEvent(new Event("change", { bubbles: true })));
    field.addEventListener("change", shown);
    plot.over.append(handle);
    return shown;
  };
  const send = async (files) => {
    const said = document.getElementById("said"), place = document.getElementById("drop");
    const refused = [];
    for (const file of files) {
      said.textContent = `Copying ${file.name} …`;
      const answer = await fetch(place.dataset.to + encodeURIComponent(file.name), { method: "POST", body: file });
      if (!answer.ok) refused.push(await answer.text());
    }
    sessionStorage.setItem("refused", refused.join(" "));
    location.reload();
  };
  const place = document.getElementById("drop");
  if (place) {
    document.getElementById("said").textContent = sessionStorage.getItem("refused"); // of the files before this reload
    sessionStorage.removeItem("refused");
    for (const kind of ["dragover", "dragenter"]) place.addEventListener(kind, (one) => { one.preventDefault(); place.classList.add("over"); });
    place.addEventListener("dragleave", () => place.classList.remove("over"));
    place.addEventListener("drop", (one) => { one.preventDefault(); place.classList.remove("over"); send([...one.dataTransfer.files]); });
    document.getElementById("choose").addEventListener("change", (one) => send([...one.target.files]));
    for (const kind of ["dragover", "drop"]) addEventListener(kind, (one) => one.preventDefault()); // beside the zone: do not leave the page
  }
  document.addEventListener("change", (one) => { if (one.target.dataset.go) location = one.target.dataset.go + encodeURIComponent(one.target.value); });
  const fault = (text) => { document.getElementById("fault").textContent = text; };
  document.addEventListener("htmx:afterRequest", (one) => { if (one.detail.successful) fault(""); });
  document.addEventListener("htmx:responseError", (one) => fault(`Not saved: ${one.detail.xhr.responseText}`));
  document.addEventListener("htmx:sendError", () => fault("Not saved: impc app does not answer. Was its window closed? Start it again, and repeat the last answer."));
  document.addEventListener("htmx:oobAfterSwap", () => plots(document));
  document.addEventListener("DOMContentLoaded", () => plots(document));
})();

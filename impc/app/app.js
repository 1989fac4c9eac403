"use strict";
// Drop zone, plots, and the choice of the trial that is shown. Everything else is HTML and htmx.
(() => {
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const plots = (place) => {
    for (const one of place.querySelectorAll(".plot")) {
      if (one.querySelector(".uplot")) continue;
      const data = JSON.parse(one.querySelector("script").textContent);
      const axis = { stroke: colour("--muted"), grid: { stroke: colour("--rule"), width: 1 } };
      const size = () => ({ width: one.clientWidth || 600, height: 130 });
      const plot = new uPlot({
        ...size(), scales: { x: { time: false } }, legend: { show: false }, cursor: { sync: { key: "all" } },
        axes: [axis, { ...axis, size: 60, space: 22, label: one.dataset.unit, labelSize: 18 }], series: [{}, { stroke: colour("--accent"), width: 1 }],
      }, data, one);
      addEventListener("resize", () => plot.setSize(size()));
    }
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
  document.addEventListener("htmx:oobAfterSwap", () => plots(document));
  document.addEventListener("DOMContentLoaded", () => plots(document));
})();

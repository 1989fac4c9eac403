// What a reader's eye would find on a page, as JSON for the page around it.
(() => {
  const all = (query, place = document) => [...place.querySelectorAll(query)];
  const [silent, folded] = [[], all("details")];
  for (const one of folded) one.open = true;
  for (const table of all("table.sortable")) {
    const rows = [...table.tBodies[0].rows];
    if (rows.length < 3) continue;
    const head = table.tHead.querySelector("button");
    for (const _ of "12") head?.click();
    if (head?.parentElement.ariaSort !== "descending") silent.push("sort");
    table.tBodies[0].append(...rows);
  }
  const done = () => {
    const text = all("p, li, dd, dt, td, th, h1, h2, h3, figcaption, summary, a, button, caption, b, span")
      .filter((one) => one.offsetParent !== null && one.textContent.trim());
    const labels = all("figure svg text").filter((one) => one.getBoundingClientRect().width);
    const said = (one) => one.textContent.trim().replace(/\s+/g, " ").slice(0, 60);
    const apart = (one) => one.closest(".skip, .scroll, .chart, thead, .tip");
    const clipped = text.filter((one) => {
      const box = one.getBoundingClientRect();
      const within = getComputedStyle(one).display === "inline" || one.scrollWidth <= one.clientWidth + 1;
      return !apart(one) && (box.right > innerWidth + 1 || box.left < -1 || !within);
    });
    const outside = labels.filter((one) => {
      const [box, frame] = [one, one.closest("svg")].map((each) => each.getBoundingClientRect());
      return box.left < frame.left - 2 || box.right > frame.right + 2 || box.top < frame.top - 2 || box.bottom > frame.bottom + 2;
    });
    const channel = (value) => (value <= 10.02 ? value / 3294.6 : ((value / 255 + 0.055) / 1.055) ** 2.4);
    const numbers = (colour) => colour.match(/[\d.]+/g).map(Number);
    const light = (rgb) => 0.2126 * channel(rgb[0]) + 0.7152 * channel(rgb[1]) + 0.0722 * channel(rgb[2]);
    const behind = (one) => {
      for (let at = one; at; at = at.parentElement) {
        const rgb = numbers(getComputedStyle(at).backgroundColor);
        if (rgb.length < 4 || rgb[3] > 0) return rgb;
      }
      return [255, 255, 255];
    };
    const pale = (one, property) => {
      const [a, b] = [light(numbers(getComputedStyle(one)[property])), light(behind(one))];
      return (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05) < 4.5;
    };
    const prose = all("p, li, dd, figcaption, caption, h1, h2, h3, summary, th, td, svg text").filter((one) => !one.closest(".chart")).map((one) => {
      const copy = one.cloneNode(true);
      for (const code of all("code, script, style", copy)) code.remove();
      return copy.textContent;
    });
    const code = prose.flatMap((one) => one.match(/\b[A-Za-z]\w*_[\w.]+|\bK\.[a-z]\w*/g) || [])
      .filter((word) => !/\.(csv|json|mat|xlsx|html|log|toml|png|svg|pdf|txt|tsv)\.?$/.test(word));
    const wordless = all("svg:not([aria-hidden])").filter((one) => one.role !== "img" || !one.querySelector("title")?.textContent.trim());
    const found = {
      "script that does nothing": silent,
      "chart that is not drawn": all(".chart").filter((one) => !one.querySelector("canvas")).map((one) => one.dataset.title),
      "more or fewer than one h1": all("h1").length === 1 ? [] : ["h1"],
      "page wider than its window": document.documentElement.scrollWidth > innerWidth + 1 ? ["wide"] : [],
      "clipped": clipped.map(said),
      "label outside its figure": outside.map(said),
      "too pale": [...text.filter((one) => pale(one, "color")), ...labels.filter((one) => pale(one, "fill"))].map(said),
      "picture without words": [...wordless, ...all("img").filter((one) => !one.alt.trim())].map((one) => one.outerHTML.slice(0, 40)),
      "out of tab order": all("[tabindex]").filter((one) => one.tabIndex > 0).map(said),
      "code in prose": [...new Set(code)],
    };
    for (const one of folded) one.open = false;
    parent.postMessage(JSON.stringify([innerWidth, found]), "*");
  };
  setTimeout(done, 500);
})();

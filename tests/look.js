// What a reader's eye would find on a page, as JSON for the page around it.
(() => {
  const text = "p, li, dd, dt, td, th, h1, h2, h3, figcaption, summary, a, pre";
  const button = (words) => [...document.querySelectorAll("button")].find((one) => one.textContent === words);
  const silent = [];
  const folded = document.querySelectorAll("details");
  if (folded.length) {
    const open = button("Open all");
    if (open) open.click();
    if ([...folded].some((one) => !one.open)) silent.push("fold");
  }
  for (const one of folded) one.open = true;
  for (const table of document.querySelectorAll("table.numbers")) {
    const rows = [...table.tBodies[0].rows];
    if (rows.length < 2) continue;
    const head = table.tHead.querySelector("button");
    if (!head) { silent.push("sort"); continue; }
    head.click();
    head.click();
    if (head.parentElement.ariaSort !== "descending") silent.push("sort");
    table.tBodies[0].append(...rows);
  }
  for (const holder of document.querySelectorAll("script.chart")) {
    const open = holder.parentElement.querySelector("button");
    if (open) open.click();
    const drawn = holder.parentElement.querySelectorAll(".chart path");
    if (!drawn.length || [...drawn].some((one) => /NaN|undefined/.test(one.getAttribute("d")))) silent.push("curves");
  }
  const all = [...document.querySelectorAll(text)].filter((one) => one.offsetParent !== null);
  const said = (one) => one.textContent.trim().replace(/\s+/g, " ").slice(0, 60);
  const moves = (one) => one.closest(".scroll, figure.wide") !== null;
  const clipped = all.filter((one) => {
    const box = one.getBoundingClientRect();
    const hidden = getComputedStyle(one).position === "absolute" || one.closest("thead");
    if (moves(one)) return false;
    return !(hidden && innerWidth < 704) && (box.right > innerWidth + 1 || box.left < -1 ||
      (getComputedStyle(one).display !== "inline" && one.scrollWidth > one.clientWidth + 1));
  });
  const channel = (value) => {
    const share = value / 255;
    return share <= 0.03928 ? share / 12.92 : ((share + 0.055) / 1.055) ** 2.4;
  };
  const light = (rgb) => 0.2126 * channel(rgb[0]) + 0.7152 * channel(rgb[1]) + 0.0722 * channel(rgb[2]);
  const numbers = (colour) => colour.match(/[\d.]+/g).map(Number);
  const behind = (one) => {
    for (let at = one; at; at = at.parentElement) {
      const rgb = numbers(getComputedStyle(at).backgroundColor);
      if (rgb.length < 4 || rgb[3] > 0) return rgb;
    }
    return [255, 255, 255];
  };
  const pale = all.filter((one) => {
    const [a, b] = [light(numbers(getComputedStyle(one).color)), light(behind(one))];
    return (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05) < 4.5;
  });
  const terms = [...document.querySelectorAll("dt")].map((one) => one.textContent.trim());
  const prose = [...document.querySelectorAll("p, li, dd, figcaption, h1, h2, h3, summary, th")]
    .map((one) => {
      const copy = one.cloneNode(true);
      for (const code of copy.querySelectorAll("code")) code.remove();
      return copy.textContent;
    });
  const words = (pattern) => [...new Set(prose.flatMap((one) => one.match(pattern) || []))];
  const known = (word) => terms.some((term) => new RegExp(`(^|\\W)${word.replace(/\W/g, "\\$&")}(\\W|$)`).test(term));
  const found = {
    width: innerWidth,
    "script that does nothing": silent,
    "more or fewer than one h1": document.querySelectorAll("h1").length === 1 ? [] : ["h1"],
    "page wider than its window":
      document.documentElement.scrollWidth > innerWidth + 1 ? [String(document.documentElement.scrollWidth)] : [],
    "clipped": clipped.map(said),
    "too pale": pale.map(said),
    "picture without words": [...document.querySelectorAll("img")].filter((one) => !one.alt.trim()).map((one) => one.outerHTML.slice(0, 40)),
    "out of tab order": [...document.querySelectorAll("[tabindex]")].filter((one) => one.tabIndex > 0).map(said),
    "code in prose": words(/\b[A-Za-z]\w*[._]\w*[A-Za-z]\w*\b/g)
      .filter((word) => !/\.(csv|json|mat|xlsx|html|log|toml|png|pdf|txt|tsv)$/.test(word) && !known(word)),
    "abbreviation that is not explained": words(/\b[A-Z]{2,}[a-z]?\b/g).filter((word) => !known(word.replace(/s$/, ""))),
  };
  parent.postMessage(JSON.stringify(found), "*");
})();

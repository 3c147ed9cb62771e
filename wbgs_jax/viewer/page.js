// What the browser does by itself: the value under the pointer of a figure, and a notice when the server has stopped.
(() => {
  if (window.wbgs) return;
  window.wbgs = true;
  const style = document.createElement("style");
  style.textContent = `
    svg.wbgs { display: block; width: 100%; height: auto; font-size: 10px; touch-action: pan-y; }
    svg.wbgs text { fill: currentColor; }
    svg.wbgs .wbgs-read { font-weight: 600; }
    .wbgs-panel { padding: 0 0.75em; font-size: 0.82em; line-height: 1.35; }
    .wbgs-panel b { font-weight: 600; }
    .wbgs-title { font-weight: 600; margin: 0.1em 0; }
    .wbgs-figures { display: flex; flex-wrap: wrap; column-gap: 1.1em; }
    .wbgs-figures span { white-space: nowrap; }
    .wbgs-warning { color: #b3261e; font-weight: 600; margin: 0.15em 0; }
    .wbgs-words { margin: 0.3em 0; opacity: 0.85; }
    .wbgs-table { max-height: 11.5em; overflow-y: auto; }
    .wbgs-table table { width: 100%; border-collapse: collapse; }
    .wbgs-table td, .wbgs-table th { padding: 0.05em 0.4em; text-align: right; vertical-align: top; }
    .wbgs-table td:last-child, .wbgs-table th:last-child { text-align: left; }
    .wbgs-table tr.chosen { background: #d6272833; }
    #wbgs-stopped { position: fixed; z-index: 10000; top: 0.6em; left: 50%; transform: translateX(-50%); max-width: 92vw;
      padding: 0.6em 1em; border-radius: 6px; background: #b3261e; color: white; font: 15px sans-serif;
      box-shadow: 0 2px 8px #0006; }`;
  document.head.appendChild(style);

  const pixels = new WeakMap(); // the values of an image, read once
  function pixelsOf(image) {
    if (!pixels.has(image)) {
      const source = new Image();
      source.src = image.getAttribute("href");
      pixels.set(image, source.decode().then(() => {
        const canvas = document.createElement("canvas");
        [canvas.width, canvas.height] = [source.naturalWidth, source.naturalHeight];
        const context = canvas.getContext("2d");
        context.drawImage(source, 0, 0);
        return context.getImageData(0, 0, canvas.width, canvas.height);
      }));
    }
    return pixels.get(image);
  }

  const between = ([low, high], share) => low + share * (high - low);

  async function imageWords(svg, u, v) {
    const [left, top, width, height] = JSON.parse(svg.dataset.box);
    const [a, b] = [(u - left) / width, (v - top) / height];
    if (a < 0 || a >= 1 || b < 0 || b >= 1) return "";
    const { data, width: columns, height: rows } = await pixelsOf(svg.querySelector("image"));
    const at = 4 * (Math.floor(b * rows) * columns + Math.floor(a * columns));
    const digits = JSON.parse(svg.dataset.digits);
    const x = between(JSON.parse(svg.dataset.x), a), y = between(JSON.parse(svg.dataset.y), 1 - b);
    // Levels at the ends stand for all values beyond the scale, if that is not the range of all values.
    const level = data[at], beyond = svg.dataset.unit ? ({ 0: "≤ ", 255: "≥ " }[level] ?? "") : "";
    const number = between(JSON.parse(svg.dataset.v), level / 255).toFixed(digits[2]);
    const value = data[at + 3] === 0 ? "nothing received" : beyond + number + (svg.dataset.unit ?? "");
    return svg.dataset.read.replace("{x}", x.toFixed(digits[0])).replace("{y}", y.toFixed(digits[1])).replace("{v}", value);
  }

  function nearest(svg, u, v) {
    let best = null, least = 18;
    for (const point of JSON.parse(svg.dataset.points)) {
      const away = Math.abs(point[0] - u) + 0.05 * Math.abs(point[1] - v);
      if (away < least) [best, least] = [point, away];
    }
    return best;
  }

  async function readUnder(event) {
    const svg = event.target.closest?.("svg.wbgs");
    for (const other of document.querySelectorAll("svg.wbgs")) {
      if (other === svg) continue;
      const read = other.querySelector(".wbgs-read");
      if (read?.textContent) read.textContent = "";
      other.querySelector(".wbgs-spot")?.setAttribute("visibility", "hidden");
    }
    const read = svg?.querySelector(".wbgs-read");
    if (!read) return;
    const { x: u, y: v } = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
    if (svg.dataset.read) {
      read.textContent = await imageWords(svg, u, v);
    } else if (svg.dataset.points) {
      const point = nearest(svg, u, v), spot = svg.querySelector(".wbgs-spot");
      read.textContent = point ? point[2] : "";
      spot.setAttribute("visibility", point ? "visible" : "hidden");
      if (point) { spot.setAttribute("cx", point[0]); spot.setAttribute("cy", point[1]); }
    }
    const most = svg.viewBox.baseVal.width - Number(read.getAttribute("x")) - 2;
    read.removeAttribute("textLength");
    if (read.textContent && read.getComputedTextLength() > most) {
      read.setAttribute("textLength", most);
      read.setAttribute("lengthAdjust", "spacingAndGlyphs");
    }
  }

  // A tap on a phone is no movement.
  for (const kind of ["pointermove", "pointerdown"]) document.addEventListener(kind, readUnder);

  // viser freezes the panel while there is no connection.
  setInterval(() => {
    const probe = document.getElementById("wbgs-probe");
    const stopped = probe !== null && getComputedStyle(probe).pointerEvents === "none";
    let notice = document.getElementById("wbgs-stopped");
    if (stopped && !notice) {
      notice = document.createElement("div");
      notice.id = "wbgs-stopped";
      notice.setAttribute("role", "alert");
      notice.textContent = probe.dataset.stopped;
      document.body.appendChild(notice);
    } else if (!stopped && notice) {
      notice.remove();
    }
  }, 500);
})();

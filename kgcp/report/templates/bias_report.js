"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const columns = data.columns;
  const count = columns.frame.length;
  const REACH_PX = 16;

  const element = (name, properties = {}, children = []) => {
    const node = Object.assign(document.createElement(name), properties);
    node.append(...children);
    return node;
  };
  const shape = (name, attributes) => {
    const node = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    return node;
  };
  const print = (text) => (Number(text) === 0 ? "0" : text.replace("-", "−"));
  const number = (value, digits, unit) =>
    value === null ? "–" : `${print(value.toFixed(digits))} ${unit}`.trim();

  const values = (row) => {
    const entries = [
      ["target", columns.target[row]],
      ["time", columns.time[row] ?? "–"],
      ["distance", number(columns.distance_m[row], 3, "m")],
      ["reference", number(columns.reference_distance_m[row], 3, "m")],
      ["error", number(1000 * columns.residual_m[row], 1, "mm")],
      ["error", number(columns.residual_percent[row], 3, "%")],
      ["residual, in sd", number(data.residuals[row], 1, "")],
      ["radius", number(columns.radius_px[row], 1, "px")],
    ];
    for (const [name, label] of Object.entries(data.labels)) {
      const value = columns[name][row];
      if (value !== null) entries.push([label, print(Math.abs(value) < 1e-9 ? "0" : String(Number(value.toPrecision(4))))]);
    }
    return entries;
  };

  // A close-up, with the fitted circles as lines that stay sharp.
  const drawing = (row) => {
    const closeup = data.closeups[row];
    const svg = shape("svg", { viewBox: `0 0 ${data.closeup_px} ${data.closeup_px}`, role: "img",
      "aria-label": `Close-up of ${columns.frame[row]}` });
    svg.append(shape("image", { href: `data:image/jpeg;base64,${closeup.jpeg}`,
      width: data.closeup_px, height: data.closeup_px }));
    for (const circle of closeup.circles) {
      if (circle.length === 2) {
        const [x, y] = circle;
        for (const kind of ["under", "ring"]) {
          svg.append(shape("path", { d: `M${x - 6} ${y}H${x + 6}M${x} ${y - 6}V${y + 6}`,
            class: kind }));
        }
      } else {
        for (const kind of ["under", "ring"]) {
          svg.append(shape("polygon", { points: circle.join(" "), class: kind }));
        }
      }
    }
    return svg;
  };

  const dialog = document.getElementById("closeup");
  const show = (row) => {
    const list = element("dl");
    for (const [name, value] of values(row)) {
      list.append(element("dt", { textContent: name }), element("dd", { textContent: value }));
    }
    const left = data.closeups[row]
      ? drawing(row)
      : element("p", { className: "note", textContent:
          "This frame has no close-up. The page contains some, spread over the distances, and those " +
          "with the largest residuals." });
    dialog.querySelector("h2").textContent = columns.frame[row];
    dialog.querySelector(".halves").replaceChildren(left, list);
    dialog.dataset.row = row;
    if (!dialog.open) dialog.showModal();
  };
  dialog.addEventListener("click", (event) => {
    if (event.target === dialog) dialog.close();
  });

  const tip = element("div", { className: "tip", hidden: true, id: "tip" });
  tip.setAttribute("role", "status");
  document.body.append(tip);
  const point = (plot, spot, places, index, rows) => {
    const box = plot.getBoundingClientRect();
    const x = places[2 * index] / data.steps, y = places[2 * index + 1] / data.steps;
    spot.style.left = `${100 * x}%`;
    spot.style.top = `${100 * y}%`;
    spot.hidden = false;
    const row = rows[index];
    tip.replaceChildren(
      element("b", { textContent: columns.frame[row] }),
      [number(columns.reference_distance_m[row], 2, "m"),
        number(1000 * columns.residual_m[row], 1, "mm"),
        number(columns.residual_percent[row], 3, "%")].join("  ·  "));
    tip.hidden = false;
    const left = box.left + x * box.width, top = box.top + y * box.height;
    const size = tip.getBoundingClientRect();
    tip.style.left = `${Math.max(4, Math.min(left + 12, innerWidth - size.width - 4))}px`;
    tip.style.top = `${top + 14 + size.height < innerHeight ? top + 14 : top - 14 - size.height}px`;
  };

  const enliven = (plot) => {
    const [rows, places] = data.pictures[plot.dataset.picture];
    const spot = element("div", { className: "spot", hidden: true });
    plot.append(spot);
    plot.classList.add("live");
    plot.tabIndex = 0;
    plot.setAttribute("role", "group");
    plot.setAttribute("aria-label", "Figure: the arrow keys select its measurements");
    const order = rows.map((_, index) => index)
      .sort((a, b) => places[2 * a] - places[2 * b] || a - b);
    let current = -1;
    const nearest = (event) => {
      const box = plot.getBoundingClientRect();
      const x = (event.clientX - box.left) / box.width * data.steps;
      const y = (event.clientY - box.top) / box.height * data.steps;
      const sx = box.width / data.steps, sy = box.height / data.steps;
      let best = -1, least = REACH_PX * REACH_PX;
      for (let index = 0; index < rows.length; index++) {
        const dx = (places[2 * index] - x) * sx, dy = (places[2 * index + 1] - y) * sy;
        const square = dx * dx + dy * dy;
        if (square < least) { least = square; best = index; }
      }
      return best;
    };
    const hide = () => { current = -1; spot.hidden = true; tip.hidden = true; };
    const mark = (index, isKey = false) => {
      current = index;
      if (index < 0) { hide(); return; }
      point(plot, spot, places, index, rows);
      if (isKey) {
        spot.scrollIntoView({ block: "nearest", inline: "nearest" });
        point(plot, spot, places, index, rows);
      }
    };
    plot.addEventListener("pointermove", (event) => mark(nearest(event)));
    plot.addEventListener("pointerleave", hide);
    plot.addEventListener("blur", hide);
    plot.addEventListener("click", (event) => {
      const index = nearest(event);
      if (index >= 0) show(rows[index]);
    });
    plot.addEventListener("keydown", (event) => {
      const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
      if (step) {
        const at = order.indexOf(current);
        mark(order[at < 0 ? (step > 0 ? 0 : order.length - 1)
          : Math.max(0, Math.min(order.length - 1, at + step))], true);
      } else if (event.key === "Enter" && current >= 0) {
        show(rows[current]);
      } else if (event.key === "Escape") {
        hide();
      } else {
        return;
      }
      event.preventDefault();
    });
  };
  for (const plot of document.querySelectorAll(".plot")) {
    if (data.pictures[plot.dataset.picture]) enliven(plot);
  }

  for (const button of document.querySelectorAll("button[data-row]")) {
    button.addEventListener("click", () => show(Number(button.dataset.row)));
  }
  const gallery = document.getElementById("gallery");
  const near = (a, b) => columns.reference_distance_m[a] - columns.reference_distance_m[b];
  for (const row of Object.keys(data.closeups).map(Number).sort(near)) {
    const closeup = data.closeups[row];
    const text = `${columns.frame[row]}, ${number(columns.reference_distance_m[row], 1, "m")}`;
    const button = element("button", { type: "button", title: text }, [
      element("img", { src: `data:image/jpeg;base64,${closeup.jpeg}`, alt: "" }),
      element("span", { textContent: number(columns.reference_distance_m[row], 1, "m") }),
      element("span", { textContent: columns.frame[row] }),
    ]);
    button.addEventListener("click", () => show(row));
    gallery.append(button);
  }

  const cell = (value) => {
    const text = value === null || value === undefined ? "" : String(value);
    return /[",\n\r]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
  };
  const csv = (lines) => lines.map((line) => line.map(cell).join(",")).join("\r\n") + "\r\n";
  const save = (name, text, type) => {
    const url = URL.createObjectURL(new Blob([text], { type }));
    element("a", { href: url, download: name }).click();
    setTimeout(() => URL.revokeObjectURL(url), 1000);
  };
  const measurements = () => {
    const names = Object.keys(columns);
    const lines = [names];
    for (let row = 0; row < count; row++) lines.push(names.map((name) => columns[name][row]));
    return csv(lines);
  };
  const tableText = (table) => csv([...table.rows].map((row) =>
    [...row.cells].map((field) => field.textContent.trim().replace(/\s+/g, " ").replaceAll("−", "-"))));
  for (const button of document.querySelectorAll("button[data-save]")) {
    const name = button.dataset.save;
    button.addEventListener("click", () => {
      if (name === "bias_summary.json") {
        save(name, JSON.stringify(data.summary, null, 1), "application/json");
      } else if (name === "bias.csv") {
        save(name, measurements(), "text/csv");
      } else {
        save(name, tableText(button.parentElement.previousElementSibling.querySelector("table")), "text/csv");
      }
    });
  }
})();

"use strict";
(() => {
  const page = JSON.parse(document.querySelector('script[type="application/json"]').textContent);
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const views = new Map(); // of charts that are drawn, by name
  const shown = new Set(page.shown);
  const choices = new Map(); // of the example episode, by game: estimator, and until when

  // Data come by columns, estimators as places in a list of names; Vega takes rows.
  const rowsOf = (given) => {
    const table = given.estimator
      ? { ...given, name: given.estimator.map((place) => page.names[place]) } : given;
    const fields = Object.keys(table);
    const columns = Object.values(table);
    return columns.length ? columns[0].map((_, i) =>
      Object.fromEntries(fields.map((f, j) => [f, columns[j][i]]))) : [];
  };
  const rows = new Map();
  const datasetsOf = (key) => {
    if (!rows.has(key)) {
      rows.set(key, Object.fromEntries(
        Object.entries(page.data[key]).map(([name, table]) => [name, rowsOf(table)])));
    }
    return rows.get(key);
  };

  const theme = () => {
    const [ground, text, soft, line, others] = dark.matches
      ? ["#14171b", "#e4e7eb", "#9ba4b0", "#2b3138", "#555d68"]
      : ["#ffffff", "#1c2026", "#5b6470", "#e6e9ed", "#c3c9d1"];
    return {
      background: "transparent",
      font: 'system-ui, "Segoe UI", Roboto, Arial, sans-serif',
      range: { category: dark.matches ? page.dark : page.light },
      view: { stroke: null },
      axis: {
        labelColor: soft, titleColor: soft, gridColor: line, domainColor: line, tickColor: line,
        labelFontSize: 11, titleFontSize: 12, titleFontWeight: "normal", titlePadding: 8,
      },
      axisY: { minExtent: 42 },
      line: { strokeWidth: 2, strokeJoin: "round" },
      style: {
        others: { color: others, strokeWidth: 1 },
        reference: { color: text, strokeWidth: 1.6, strokeDash: [1, 3], strokeCap: "round" },
        floor: { color: soft, strokeWidth: 2.6, opacity: 0.75 },
        truth: { color: text, strokeWidth: 1.6 },
        reference_state: { color: text, filled: true, size: 9 },
        measured: { color: soft, filled: true, size: 7, opacity: 0.7 },
        level: { color: soft, strokeDash: [3, 3], strokeWidth: 1 },
        middle: { color: text, thickness: 2.5, size: 14 },
        name: { color: text, fontSize: 11 },
        name_ground: { color: ground, stroke: ground, strokeWidth: 3, strokeJoin: "round", fontSize: 11 },
      },
    };
  };

  const paramsOf = (name) => ({ names: page.names, shown: [...shown], ...choices.get(page.charts[name].data) });

  async function draw(place) {
    const name = place.dataset.chart;
    const { spec, data } = page.charts[name];
    const now = paramsOf(name);
    const params = (spec.params ?? []).map((p) => ({ ...p, value: now[p.name] ?? p.value }));
    const whole = { ...spec, params, config: theme(), datasets: datasetsOf(data) };
    views.get(name)?.finalize();
    const made = await vegaEmbed(place, whole, {
      actions: false, ast: true, renderer: "svg", tooltip: { theme: dark.matches ? "dark" : "light" },
    });
    views.set(name, made);
    place.dataset.drawn = dark.matches ? "dark" : "light";
  }

  const set = (name, value, key) => {
    for (const [chart, made] of views) {
      const { spec, data } = page.charts[chart];
      if ((!key || key === data) && spec.params?.some((p) => p.name === name)) {
        made.view.signal(name, value).runAsync();
      }
    }
  };

  // Charts are drawn when they come near.
  const near = new IntersectionObserver((entries) => {
    for (const { isIntersecting, target } of entries) {
      if (isIntersecting) {
        near.unobserve(target);
        draw(target);
      }
    }
  }, { rootMargin: "800px" });
  const places = [...document.querySelectorAll("[data-chart]")];
  for (const place of places) near.observe(place);
  const drawn = () => places.filter((place) => place.dataset.drawn);
  dark.addEventListener("change", () => drawn().forEach(draw));
  addEventListener("beforeprint", () => places.forEach((p) => p.dataset.drawn || draw(p)));

  for (const chip of document.querySelectorAll(".chip")) {
    const name = Number(chip.dataset.estimator);
    chip.setAttribute("aria-pressed", shown.has(name));
    chip.addEventListener("click", () => {
      if (!shown.delete(name)) shown.add(name);
      chip.setAttribute("aria-pressed", shown.has(name));
      set("shown", [...shown]);
    });
  }
  for (const choice of document.querySelectorAll("select[data-game]")) {
    const key = `game${choice.dataset.game}`;
    const name = choice.dataset.param;
    const take = () => {
      const end = page.data[key].truth.t.at(-1);
      const value = Number(choice.value);
      choices.set(key, { ...choices.get(key), [name]: name === "until" ? end * value : value });
    };
    take();
    choice.addEventListener("change", () => {
      take();
      set(name, choices.get(key)[name], key);
    });
  }
  document.querySelector("select.systems")?.addEventListener("change", (event) => {
    for (const box of document.querySelectorAll("[data-heat]")) {
      box.hidden = box.dataset.heat !== event.target.value;
    }
  });

  // A click on a column's head sorts by it: numbers by size, with nothing at the end.
  const numberOf = (text) => {
    if (text.startsWith("∞") || text.startsWith("div")) return Infinity;
    return parseFloat(text.replaceAll(",", ""));
  };
  for (const table of document.querySelectorAll("table.sortable")) {
    const heads = [...table.tHead.rows[0].cells];
    const body = table.tBodies[0];
    const textOf = (row, i) => row.cells[i].textContent.trim();
    heads.forEach((head, i) => {
      const texts = [...body.rows].map((row) => textOf(row, i)).filter(Boolean);
      const numeric = texts.length > 0 && texts.every((text) => !Number.isNaN(numberOf(text)));
      if (!numeric) {
        head.classList.add("text");
        for (const row of body.rows) row.cells[i].classList.add("text");
      }
      head.firstElementChild.addEventListener("click", () => {
        const down = head.getAttribute("aria-sort") === "ascending";
        heads.forEach((other) => other.removeAttribute("aria-sort"));
        for (const row of body.rows) row.classList.remove("begins");  // tracks are mixed now
        head.setAttribute("aria-sort", down ? "descending" : "ascending");
        const compare = (a, b) => {
          const [f, g] = [a, b].map((row) => row.classList.contains("floor"));
          if (f !== g) return f - g;  // the floor stays at the end
          const [s, t] = [textOf(a, i), textOf(b, i)];
          if (!s || !t) return !s - !t;
          const [m, n] = [numberOf(s), numberOf(t)];
          const order = numeric ? (m === n ? 0 : m - n) : s.localeCompare(t);
          return down ? -order : order;
        };
        body.append(...[...body.rows].sort(compare));
      });
    });
  }
})();

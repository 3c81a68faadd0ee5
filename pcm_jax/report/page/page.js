// The picked closure's panel, the theme, and the start.
(() => {
  const { data, state } = pcm;
  const MOST_NAMED = 24;
  const nothing = document.getElementById("picked-body").textContent;
  const byId = (name) => document.getElementById(name);
  const make = (name, text, className) => {
    const element = document.createElement(name);
    if (text !== undefined) element.textContent = text;
    if (className) element.className = className;
    return element;
  };

  function facts(row) {
    const cells = [...row.cells];
    const heads = [...row.closest("table").tHead.rows[0].cells].map((cell) => cell.textContent);
    const list = make("dl", undefined, "making");
    [1, 4, 5, 6].forEach((k) => {
      if (cells[k].textContent === "–") return;
      list.append(make("dt", heads[k]), make("dd", cells[k].textContent));
    });
    const more = data.closures.more[Number(row.dataset.closure)] || [];
    more.forEach(([term, text]) => list.append(make("dt", term), make("dd", text)));
    const source = cells[1].dataset.source;
    if (source) list.append(make("dt", "Source"), make("dd", source));
    return list;
  }

  function named(title, closures) {
    const part = document.createDocumentFragment();
    if (!closures.length) return part;
    part.append(make("h3", title));
    const list = make("p", undefined, "chips");
    closures.slice(0, MOST_NAMED).forEach((k) => {
      const mark = { accepted: "●", refused: "○", rival: "◆", rejected: "✕" }[data.closures.fate[k]];
      const button = pcm.button(`${mark} ${k}`, `Closure ${k}, ${data.closures.fate[k]}`, () => pcm.pick(k));
      button.className = `chip ${data.closures.fate[k]}`;
      list.append(button);
    });
    if (closures.length > MOST_NAMED) list.append(` and ${closures.length - MOST_NAMED} more`);
    part.append(list);
    return part;
  }

  function show() {
    const panel = byId("picked");
    const body = byId("picked-body");
    const none = state.picked === null;
    panel.classList.toggle("is-empty", none);
    document.body.classList.toggle("has-picked", !none);
    if (none) {
      byId("picked-title").textContent = "No closure picked";
      body.replaceChildren(make("p", nothing));
      return;
    }
    const row = pcm.rowOf(state.picked);
    byId("picked-title").textContent = `Closure ${state.picked}`;
    const fate = row.querySelector(".fate");
    body.replaceChildren(make("p", fate.textContent, fate.className), make("p", row.querySelector(".why").textContent, "sentence"));
    body.append(facts(row));
    const relations = pcm.relations(state.picked);
    if (relations) {
      const some = relations.ofSet ? relations.set : relations.all;
      body.append(
        named(`Contradicts ${relations.contradicts.length} ${some}, the worst first`, relations.contradicts),
        named(`Agrees with ${relations.agrees.length} ${some}`, relations.agrees),
      );
    }
    else if (data.pairs.length) body.append(make("p", "It is not among those whose agreement with others is drawn.", "note"));
    body.scrollTop = 0;
  }

  function step(by) {
    const rows = pcm.shownRows();
    const at = rows.findIndex((row) => Number(row.dataset.closure) === state.picked);
    const next = rows[(at + by + rows.length) % rows.length];
    if (next) pcm.pick(Number(next.dataset.closure));
  }

  function fromAddress() {
    const found = /^#closure-(\d+)$/.exec(window.location.hash);
    if (found) pcm.pick(Number(found[1]));
  }

  function theme() {
    const button = byId("theme");
    const system = window.matchMedia("(prefers-color-scheme: dark)");
    const isDark = () => (document.documentElement.dataset.theme || (system.matches ? "dark" : "light")) === "dark";
    const tell = () => {
      button.setAttribute("aria-pressed", String(isDark()));
      pcm.tell("theme");
    };
    button.addEventListener("click", () => {
      document.documentElement.dataset.theme = isDark() ? "light" : "dark";
      tell();
    });
    system.addEventListener("change", tell);
    button.setAttribute("aria-pressed", String(isDark()));
  }

  pcm.startTable();
  pcm.startMaps();
  pcm.startAgreement();
  pcm.startCalibration();
  theme();
  pcm.on("pick", show);
  byId("picked-close").addEventListener("click", () => pcm.pick(null));
  byId("picked-previous").addEventListener("click", () => step(-1));
  byId("picked-next").addEventListener("click", () => step(1));
  document.addEventListener("keydown", (event) => {
    if (event.key === "Escape") pcm.pick(null);
  });
  window.addEventListener("hashchange", fromAddress);
  fromAddress();
  document.documentElement.dataset.ready = "true";
})();

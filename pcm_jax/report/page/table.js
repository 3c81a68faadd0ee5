// The table of closures: sorted by tablesort, filtered by text, fate and robots.
pcm.startTable = () => {
  const table = document.getElementById("closures-table");
  const rows = [...table.tBodies[0].rows];
  const text = new Map(rows.map((row) => [row, `${row.textContent} ${row.cells[1].dataset.source || ""}`.toLowerCase()]));
  const control = (name) => document.getElementById(name);
  new Tablesort(table);
  // The buttons in the heads take the keyboard, so the heads themselves need not.
  table.querySelectorAll("th[role=columnheader]").forEach((head) => head.removeAttribute("tabindex"));

  function filter() {
    const asked = control("find").value.trim().toLowerCase();
    const fate = control("fate").value;
    const pair = control("pair") ? control("pair").value : "";
    rows.forEach((row) => {
      const kept =
        (!fate || row.dataset.fate === fate) &&
        (!pair || row.dataset.pair === pair) &&
        (!asked || (/^\d+$/.test(asked) ? row.dataset.closure === asked : text.get(row).includes(asked)));
      row.hidden = !kept;
    });
    const shown = rows.filter((row) => !row.hidden).length;
    control("shown").textContent = `${shown} of ${rows.length} closures shown`;
  }
  ["find", "fate", "pair"].forEach((name) => control(name) && control(name).addEventListener("input", filter));

  table.tBodies[0].addEventListener("click", (event) => {
    const row = event.target.closest("tr");
    if (row) pcm.pick(Number(row.dataset.closure));
  });
  pcm.on("pick", ({ picked }) => {
    rows.forEach((row) => {
      const is = Number(row.dataset.closure) === picked;
      row.classList.toggle("is-picked", is);
      row.querySelector("button").setAttribute("aria-pressed", String(is));
    });
  });
  pcm.rowOf = (closure) => document.getElementById(`closure-${closure}`);
  pcm.shownRows = () => [...table.tBodies[0].rows].filter((row) => !row.hidden);
};

"use strict";
// The page's data, what the reader has picked, and who is told when that changes.
const pcm = (() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const state = { picked: null, hidden: new Set(), plane: data.plane, pair: 0 };
  const listeners = { pick: [], hidden: [], plane: [], pair: [], theme: [] };
  const on = (event, listener) => listeners[event].push(listener);
  const tell = (event) => listeners[event].forEach((listener) => listener(state));

  // Distances: the strict upper triangle, row by row, a byte each; under 128 the two agree.
  data.pairs.forEach((pair) => {
    const bytes = Uint8Array.from(atob(pair.distances), (c) => c.charCodeAt(0));
    const n = pair.closures.length;
    pair.level = (i, j) => {
      if (i === j) return 0;
      const [a, b] = i < j ? [i, j] : [j, i];
      return bytes[a * n - (a * (a + 1)) / 2 + b - a - 1];
    };
    pair.agree = (i, j) => pair.level(i, j) < 128;
    pair.isMember = new Set(pair.members);
    pair.isRival = new Set(pair.rival);
    pair.place = new Map(pair.closures.map((closure, at) => [closure, at]));
    // Times the gate, from a byte.
    pair.times = (i, j) => {
      const level = pair.level(i, j);
      return level < 128 ? level / 127 : 2 ** ((level - 128) / 12);
    };
  });

  // What is said where a pair of robots has more closures than are drawn.
  const thinned = (pair) =>
    pair.left_out ? `${pair.closures.length} of ${pair.closures.length + pair.left_out} closures are drawn, with all of the set found and its rival` : "";

  const count = data.closures.fate.length;
  const pairOf = (closure) => data.pairs.findIndex((pair) => pair.place.has(closure));

  // The closures that one agrees with and contradicts: of the set found between its two robots, or,
  // of a member of that set, of all.
  function relations(closure) {
    const pair = data.pairs[pairOf(closure)];
    if (!pair) return null;
    const at = pair.place.get(closure);
    const isMember = pair.isMember.has(at);
    const others = pair.closures.map((_, k) => k).filter((k) => k !== at);
    const among = pair.members.length && !isMember ? pair.members : others;
    const named = pair.place.get(data.closures.worst[closure]);
    const worst = (i, j) => (j === named) - (i === named) || pair.level(at, j) - pair.level(at, i);
    return {
      ofSet: pair.members.length > 0 && !isMember,
      all: pair.left_out ? "of those drawn" : "of all",
      set: pair.accepted ? "accepted" : "found to agree",
      agrees: among.filter((k) => pair.agree(at, k)).map((k) => pair.closures[k]),
      contradicts: among.filter((k) => !pair.agree(at, k)).sort(worst).map((k) => pair.closures[k]),
    };
  }

  function pick(closure) {
    state.picked = closure !== null && closure >= 0 && closure < count ? closure : null;
    const pair = state.picked === null ? -1 : pairOf(state.picked);
    if (pair >= 0 && pair !== state.pair) choosePair(pair);
    tell("pick");
  }
  function choosePair(pair) {
    state.pair = pair;
    tell("pair");
  }
  function toggle(fate, shown) {
    state.hidden[shown ? "delete" : "add"](fate);
    tell("hidden");
  }
  function choosePlane(plane) {
    state.plane = plane;
    tell("plane");
  }
  const axes = () => [...state.plane].map((axis) => "xyz".indexOf(axis));
  return { data, state, on, tell, pick, choosePair, toggle, choosePlane, relations, thinned, axes, count };
})();

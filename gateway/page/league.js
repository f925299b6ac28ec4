// The players of a game with opponents: their ratings, and who wins against whom.

import { byId, element, setText, shape } from "./dom.js";
import { counted, number, percent, whole } from "./format.js";
import { Table } from "./table.js";

const NEWEST = "newest";
const BAND = { width: 200, height: 14 }; // of the picture of a rating, in pixels
const STRONGEST = 45; // percent of the colour in a cell of the matrix, so that its text can be read

export class League {
  #table = new Table("Players", ["rating", -1]);
  #matrix = element("div", { class: "scroll matrix", tabindex: "0", role: "region", "aria-label": "Win rates" });

  constructor() {
    byId("players").append(this.#table.root);
    byId("matrix").append(this.#matrix);
  }

  /** Show a message: the league, or null if the run has none. */
  show({ league }) {
    byId("league").hidden = !league?.players.length;
    if (byId("league").hidden) return;
    const { players, scores, left_out: more } = league;
    const results = byPair(scores);
    const ends = [Math.min(...players.map(({ rating, deviation }) => rating - deviation)), Math.max(...players.map(({ rating, deviation }) => rating + deviation))];
    this.#table.show(columns(ends), players.map((each) => ({ ...each, score: results.get(NEWEST)?.get(each.player) })));
    setText(byId("league-note"), more ? `${counted(more, "player")} more are kept, and not shown here.` : "");
    this.#matrix.replaceChildren(matrix(players.map(({ player }) => player), results));
  }
}

/** Return the results of each player against each other one, whoever was named first. */
function byPair(scores) {
  const results = new Map();
  const add = (first, second, wins, draws, losses) => {
    const matches = wins + draws + losses;
    if (!matches) return;
    if (!results.has(first)) results.set(first, new Map());
    results.get(first).set(second, { wins, draws, losses, matches, rate: (wins + draws / 2) / matches });
  };
  for (const { first, second, wins, draws, losses } of scores) {
    add(first, second, wins, draws, losses);
    add(second, first, losses, draws, wins);
  }
  return results;
}

function columns([low, high]) {
  const at = (value) => ((value - low) / (high - low || 1)) * BAND.width;
  const draw = (cell, { rating, deviation }) => {
    const [from, to] = [at(rating - deviation), at(rating + deviation)];
    const band = shape("rect", { class: "band", x: from, width: Math.max(to - from, 1), y: 2, height: BAND.height - 4 });
    const mark = shape("circle", { class: "mark", cx: at(rating), cy: BAND.height / 2, r: 3 });
    cell.replaceChildren(shape("svg", { class: "rating", "aria-hidden": "true", viewBox: `-3 0 ${BAND.width + 6} ${BAND.height}` }, band, mark));
  };
  return [
    { name: "player", title: "Player", text: (row) => row.player, value: (row) => row.player },
    { name: "rating", title: "Rating", number: true, text: (row) => `${whole(row.rating)} ± ${whole(row.deviation)}`, value: (row) => row.rating },
    { name: "band", title: "Band", draw, value: (row) => row.deviation },
    { name: "matches", title: "Matches", number: true, text: (row) => whole(row.matches), value: (row) => row.matches },
    { name: "wins", title: "Newest wins", number: true, text: ({ score }) => (score ? percent(score.rate) : "-"), value: ({ score }) => score?.rate ?? -1 },
  ];
}

/** Return the table of win rates: of the player of a row against the player of a column. */
function matrix(names, results) {
  const head = names.map((name) => element("th", { scope: "col" }, element("span", {}, name)));
  const rows = names.map((first) => {
    const cells = names.map((second) => cell(first, second, results.get(first)?.get(second)));
    return element("tr", {}, element("th", { scope: "row" }, first), ...cells);
  });
  const corner = element("th", { scope: "col" }, "Wins of, against");
  return element(
    "table",
    {},
    element("caption", {}, "Win rates in percent: of the player of a row against that of a column; a draw is half a win"),
    element("thead", {}, element("tr", {}, corner, ...head)),
    element("tbody", {}, ...rows),
  );
}

function cell(first, second, score) {
  if (first === second) return element("td", { class: "self" });
  if (!score) return element("td", { class: "number", title: `${first} and ${second} have not played` }, "-");
  const { wins, draws, losses, matches, rate } = score;
  const title = `${first} against ${second}: ${percent(rate)} of ${number(matches)} matches (${number(wins)} won, ${number(draws)} drawn, ${number(losses)} lost)`;
  const made = element("td", { class: `number ${rate < 0.5 ? "loses" : "wins"}`, title }, percent(rate).replace(" %", ""));
  made.style.setProperty("--share", `${Math.round(2 * STRONGEST * Math.abs(rate - 0.5))}%`);
  return made;
}

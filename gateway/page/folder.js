// What the directory of the run has: its settings, and what its actors and evaluations printed.

import { byId, element, setText } from "./dom.js";
import { counted } from "./format.js";

export class Folder {
  /** Show a message: settings [name, value, whether it differs from the default], and the output, both null if refused. */
  show({ settings, output }) {
    byId("folder").hidden = settings !== null && !settings.length && !output;
    byId("unchanged-part").hidden = settings === null;
    const refused = "Settings and output are shown to holders of a token: start the gateway with --operator-token FILE.";
    if (settings === null) return setText(byId("output-note"), refused);
    const [changed, unchanged] = [true, false].map((wanted) => settings.filter(([, , differs]) => differs === wanted));
    byId("changed").replaceChildren(table("Settings that differ from their defaults", changed));
    byId("unchanged").replaceChildren(table("Settings at their defaults", unchanged));
    setText(byId("unchanged-title"), `${counted(unchanged.length, "setting")} at the default`);
    this.#print(output);
  }

  #print(output) {
    const pane = byId("output");
    const atEnd = pane.scrollTop + pane.clientHeight >= pane.scrollHeight - 4;
    pane.hidden = !output;
    setText(byId("output-note"), output ? "The newest lines are at the end." : "Nothing was printed yet.");
    setText(pane, output);
    if (atEnd) pane.scrollTop = pane.scrollHeight;
  }
}

/** Return a table of names and values in a region that scrolls. */
function table(label, settings) {
  const rows = settings.map(([name, value]) =>
    element("tr", {}, element("th", { scope: "row" }, name), element("td", { class: "text" }, value)),
  );
  const content = element("table", {}, element("caption", {}, label), element("tbody", {}, ...rows));
  return element("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": label }, content);
}

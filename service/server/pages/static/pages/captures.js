/** The page of captures and environments: lists them, and uploads new ones. */

import { listing, load } from "../api.js";
import { askHowToImport, mountDropZone } from "../upload/drop_zone.js";
import { byId, element, time } from "../element.js";
import { intakeItem } from "../home/items.js";
import { removeLater } from "../object/removal.js";
import { newest } from "../once.js";

const asked = { captures: newest(), environments: newest() };

/** Return what fills a list, when all of it is here. */
async function list(what) {
  const isNewest = asked[what]();
  const body = byId(what).tBodies[0];
  const rows = [];
  for await (const item of listing(`/v1/${what}`, "items")) {
    const name = what === "captures" ? element("a", { href: `/captures/${item.id}` }, item.name) : item.name;
    const deletion = element("button", { type: "button", class: "bare", "aria-label": `Delete ${item.name}`, onclick: () => removeLater(`/v1/${what}/${item.id}`, item.name, "/captures") }, "Delete"); // environments have no page of their own
    rows.push(element("tr", {}, element("td", {}, name, " ", element("small", {}, item.id)),
      element("td", {}, element("span", { class: `state ${item.state}` }, item.state)),
      element("td", {}, item.problem ?? intakeItem(what, item).size, " ", question(item)), element("td", {}, time(item.created_at), " ", what === "captures" ? null : deletion)));
  }
  return () => isNewest() && body.replaceChildren(...(rows.length > 0 ? rows : [element("tr", {}, element("td", { colspan: 4 }, `There are no ${what} yet.`))]));
}

/** Return the button that asks how files are imported that were looked at, perhaps in another tab; null where there is nothing to ask. */
function question(item) {
  if (item.facts?.proposal === undefined || item.state === "checking") return null;
  return element("button", { type: "button", class: "quiet", onclick: () => askHowToImport(item) }, "Choose and import");
}

mountDropZone(async (what) => (await list(what))());
await load(async () => { for (const fill of await Promise.all([list("captures"), list("environments")])) fill(); });

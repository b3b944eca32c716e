/** The home page: all captures, sequences, assets and environments as cards, and the jobs above them. */

import { attempt, load, newToken, postOnce, read, Refusal, send } from "../api.js";
import { isUnderWay, mountDropZone } from "../upload/drop_zone.js";
import { byId, setChildren, show, words } from "../element.js";
import { captureOf } from "../view_jobs.js";
import { titleOf } from "../jobs_table.js";
import { newest, once } from "../once.js";
import { cardOf, setPicture } from "./card.js";
import { assetItem, chosen, intakeItem, itemsOf } from "./items.js";
import { Jobs } from "./jobs.js";
import { environmentPicture, pictureOf } from "./picture.js";
import { showStrip } from "./strip.js";

const LISTS = ["captures", "environments", "assets"];
const PAGE = 60; // cards that are added at once
const items = new Map();
const cards = new Map(); // of the items that have been shown
const refreshed = {}; // by the name of a list or the identifier of what was asked for again
const asked = new Set(); // captures whose view this page has asked for
let most = PAGE;
let isLoaded = false;
let mayPrepare = true;
const wanted = { words: byId("search"), order: byId("order"), get kind() { return byId("bar").elements.namedItem("kind"); } };
let sampleToken = newToken(); // a request that is sent again registers one sample
const jobs = new Jobs(changed);
const nameOf = (id) => items.get(id)?.name;

const sight = new IntersectionObserver((entries) => {
  for (const { target, isIntersecting } of entries) {
    target.classList.toggle("in-sight", isIntersecting);
    if (isIntersecting && target.dataset.picture === undefined) showPicture(target);
  }
  prepareNext();
}, { rootMargin: "200px" });

/** Show the cards that are asked for, as many as there is room for. */
function draw() {
  const asks = { words: wanted.words.value, kind: wanted.kind.value, order: wanted.order.value };
  const found = chosen(items.values(), asks);
  const focused = document.activeElement;
  setChildren(byId("wall"), found.slice(0, most).map((item) => cards.get(item.id) ?? makeCard(item)));
  if (byId("wall").contains(focused)) focused.focus({ preventScroll: true }); // what is moved loses it
  byId("count").textContent = !isLoaded || items.size === 0 ? "" : found.length === items.size ? `${found.length} in all` : `${found.length} of ${items.size}`;
  show(byId("more"), found.length > most);
  show(byId("empty"), isLoaded && items.size === 0);
  show(byId("close"), items.size > 0); // where nothing is here yet, the panel stays
  if (isLoaded && items.size === 0) openDropZone();
  const address = new URLSearchParams(Object.entries(asks).filter(([name, value]) => value !== (name === "order" ? "newest" : "")));
  history.replaceState(null, "", address.size === 0 ? location.pathname : `?${address}`);
}

function makeCard(item) {
  const card = cardOf(item);
  cards.set(item.id, card);
  sight.observe(card);
  return card;
}

function openDropZone() {
  show(byId("drop"), true);
}

/** Close the panel. What is still sent, or waits for a choice, stays in sight. */
function closeDropZone() {
  show(byId("drop"), false);
  for (const line of [...byId("uploads").children]) if (!isUnderWay(line)) line.remove();
}

/** Take an item as it is now. */
function put(item) {
  items.set(item.id, item);
  const before = cards.get(item.id);
  if (before === undefined) return;
  sight.unobserve(before);
  const isFocused = before.contains(document.activeElement);
  const card = makeCard(item);
  before.replaceWith(card);
  if (isFocused) card.querySelector("a")?.focus({ preventScroll: true });
}

async function showPicture(card) {
  const item = items.get(card.dataset.id);
  card.dataset.picture = "";
  try {
    const picture = item.kind === "environment" ? item.state === "ready" ? await environmentPicture(item.source) : null : await viewPicture(item);
    if (picture === null) return;
    setPicture(card, picture.canvas);
    picture.mount(card);
  } catch (error) {
    if (!(error instanceof Refusal)) console.warn(`${item.name} has no picture:`, error.message); // the drawing of its kind stays
  }
}

/** Return the capture that an item comes from; an asset without a name of its own gets that of its capture. */
async function captureItem(item) {
  if (item.kind !== "asset") return item;
  const capture = items.get(await captureOf(item.source));
  item.name ||= capture?.name ?? words(item.kind);
  cards.get(item.id)?.querySelector("h3").firstChild.replaceChildren(item.name);
  return capture;
}

/** Give all assets their names, which are searched. */
async function nameAssets() {
  for (const item of items.values()) if (item.name === "") await captureItem(item);
  draw();
}

async function viewPicture(item) {
  const capture = await captureItem(item);
  return capture?.source.view ? pictureOf(capture.source.view) : null;
}

/** Prepare the view of one capture that is in sight and has none, while nothing else is to be done. */
async function prepareNext() {
  if (!mayPrepare || !isLoaded || jobs.active > 0) return;
  const isWanted = (item) => item !== undefined && ["capture", "sequence"].includes(item.kind) && item.state === "ready" && !item.source.view && !asked.has(item.id);
  const card = [...byId("wall").querySelectorAll(".in-sight")].find(({ dataset }) => isWanted(items.get(dataset.id)));
  if (card === undefined) return;
  const item = items.get(card.dataset.id);
  mayPrepare = false;
  asked.add(item.id);
  const body = JSON.stringify({ kind: "view", capture: item.id, ...(item.kind === "sequence" ? { step: 1 } : {}) });
  try {
    jobs.take(await (await send("/v1/jobs", { method: "POST", body, headers: { "Content-Type": "application/json", "Idempotency-Key": `card-${item.id}` } })).json());
    mayPrepare = true;
  } catch {
    // a key that may only read, or a service that takes no jobs now: this page asks no more, and the drawings stay
  }
}

/** Take over what a change of a job changes on the wall. */
async function changed(job) {
  showStrip(byId("strip"), jobs.all, (each) => titleOf(each, nameOf), jobs.fault);
  if (job !== null && ["succeeded", "failed", "cancelled"].includes(job.state)) {
    const { kind, capture = null, intake = capture } = job.request;
    if (["view", "check"].includes(kind) && intake !== null) await attempt(() => refresh(intake));
    else if (job.state === "succeeded" && ["export", "pipeline"].includes(kind)) put(assetItem(job));
    draw();
  }
  prepareNext();
}

async function refresh(id) {
  const list = id.startsWith("env_") ? "environments" : "captures";
  const isNewest = (refreshed[id] ??= newest())();
  try {
    const found = await read(`/v1/${list}/${id}`);
    if (isNewest()) put(intakeItem(list, found));
  } catch (error) {
    if (error.status !== 404) throw error;
    items.delete(id);
  }
}

/** Register the sample and its environment, show each as it is there, and go on at the first card. */
async function openSample() {
  const button = byId("sample");
  button.disabled = true;
  try {
    for (const list of ["captures", "environments"]) {
      put(intakeItem(list, await postOnce(`/v1/samples/${list}`, undefined, `${sampleToken}-${list}`)));
      draw();
    }
    sampleToken = newToken(); // who has deleted it can open it again
  } finally {
    button.disabled = false;
    if (document.activeElement === document.body) (byId("wall").querySelector("a") ?? button).focus();
  }
}

async function showProject() {
  byId("project").textContent = `Project ${(await read("/v1/project")).name}`;
}

async function fill(list) {
  const isNewest = (refreshed[list] ??= newest())();
  const found = await itemsOf(list);
  if (!isNewest()) return;
  found.forEach(put);
  draw();
}

const address = new URLSearchParams(location.search);
wanted.words.value = address.get("words") ?? "";
for (const [name, control] of [["kind", wanted.kind], ["order", wanted.order]]) {
  if (address.has(name)) control.value = address.get(name);
}
byId("bar").addEventListener("input", () => { most = PAGE; draw(); });
byId("search").addEventListener("input", () => attempt(() => once(items, nameAssets)));
byId("bar").addEventListener("submit", (event) => event.preventDefault());
byId("more").addEventListener("click", () => { most += PAGE; draw(); });
new IntersectionObserver(([entry]) => { if (entry.isIntersecting && !byId("more").hidden) byId("more").click(); }, { rootMargin: "600px" }).observe(byId("more"));
byId("add").addEventListener("click", () => {
  openDropZone();
  byId("folder").click(); // what most people want; the panel stays for the rest
});
byId("close").addEventListener("click", () => { closeDropZone(); byId("add").focus(); });
addEventListener("dragenter", () => { openDropZone(); document.body.classList.add("dragging"); });
for (const over of ["drop", "dragend"]) addEventListener(over, () => document.body.classList.remove("dragging"), true);
addEventListener("dragleave", (event) => event.relatedTarget === null && document.body.classList.remove("dragging"));
byId("sample").addEventListener("click", () => attempt(openSample));
mountDropZone(fill);
closeDropZone();

attempt(showProject); // the cards do not wait for it
await load(async () => {
  const [lists] = await Promise.all([Promise.all(LISTS.map(itemsOf)), jobs.load()]);
  lists.flat().forEach(put); // captures first, whose pictures and names assets have
  isLoaded = true;
  draw();
  if (wanted.words.value !== "") attempt(() => once(items, nameAssets));
  changed(null);
});
await attempt(() => jobs.follow());

/** What lies over the picture: numbered notes, and a scale bar. */

const BAR_PX = 120; // the longest bar

/**
 * Make the notes.
 * @param {HTMLElement} layer Over the picture. @param {HTMLElement} section With a list. @param {object[]} notes Of scene.json.
 * @param {function(object): void} go Called with a note that is chosen.
 * @returns {function(function(number, number): number[]): void} Puts them where a function from the image to the screen says.
 */
export function mountNotes(layer, section, notes, go) {
  section.hidden = notes.length === 0;
  const button = (text, note) => Object.assign(document.createElement("button"), { type: "button", textContent: text, onclick: () => go(note) });
  const marks = notes.map((note, index) => {
    const item = document.createElement("li");
    item.append(button(note.text, note));
    section.querySelector("ol").append(item);
    const area = Object.assign(document.createElement("div"), { className: "area", hidden: note.width === 0 && note.height === 0 });
    const mark = button(String(index + 1), note);
    mark.title = note.text;
    mark.setAttribute("aria-label", `Note ${index + 1}: ${note.text}`);
    layer.append(area, mark);
    return { note, area, mark };
  });
  return (placeOf) => marks.forEach(({ note, area, mark }) => {
    const [left, top] = placeOf(note.x, note.y);
    const [right, bottom] = placeOf(note.x + note.width, note.y + note.height);
    Object.assign(area.style, { left: `${left}px`, top: `${top}px`, width: `${right - left}px`, height: `${bottom - top}px` });
    Object.assign(mark.style, { left: `${left}px`, top: `${top}px` });
  });
}

/** Show a bar of 1, 2 or 5 times a power of ten; `millimetres` is the size of a CSS pixel. */
export function showScale(bar, millimetres) {
  const longest = BAR_PX * millimetres;
  const power = 10 ** Math.floor(Math.log10(longest));
  const length = [5, 2, 1].map((each) => each * power).find((each) => each <= longest);
  bar.hidden = false;
  bar.style.width = `${length / millimetres}px`;
  bar.firstElementChild.textContent = length >= 1000 ? `${length / 1000} m` : length >= 10 ? `${length / 10} cm` : length >= 1 ? `${length} mm` : `${+(1000 * length).toPrecision(3)} µm`;
}

// The language of the page. Its texts stand in the scripts, in English; each other language is a file with tables from them to its
// own, named here and in the list of the assets. Numbers have the decimal separator of the browser's locale.

import german from "./de.js";

const TABLES = { de: german };

const wanted = navigator.languages.map((tag) => tag.split("-")[0].toLowerCase());
/// The first language of the browser that there is.
export const language = wanted.find((tag) => tag === "en" || tag in TABLES) ?? "en";
const { texts = {}, words = {}, units = {} } = TABLES[language] ?? {};

/// A text in the language of the page; `{name}` in it stands for a value.
export function t(english, values = {}) {
  return (texts[english] ?? english).replace(/\{(\w+)\}/g, (hole, name) => values[name] ?? hole);
}

const separator = (1.5).toLocaleString(navigator.language).replace(/\d/g, "");

/// A number with that many decimals.
export const decimal = (value, digits) => value.toFixed(digits).replace(".", separator);

/// A name of the gateway in words.
export const wordsOf = (name) => words[name] ?? name.replaceAll("_", " ");

/// A unit as it is written in the language of the page.
export const unitOf = (unit) => units[unit] ?? unit;

/// A number with the decimals that it has.
export const plain = (value) => String(value).replace(".", separator);

/// What somebody typed, with a comma or a point before the decimals; `null` if it is not a number.
export function numberOf(typed) {
  const digits = typed.trim().replace("−", "-");
  return /^[+-]?(\d+([.,]\d*)?|[.,]\d+)$/.test(digits) ? Number(digits.replace(",", ".")) : null;
}

// The order of names: the daemon's own (natural_order in src/pipeline/files/frame_number.rs). tests/natural_order.txt holds both to it.

/** Compares names with their numbers by value, however long; equal numbers with fewer zeros in front come first. */
export function natural(a, b) {
  const [left, right] = [partsOf(a), partsOf(b)];
  const shared = Math.min(left.length, right.length);
  for (let i = 0; i < shared; i++) {
    const compared = compare(left[i], right[i]);
    if (compared !== 0) return compared;
  }
  // Only leading zeros still differ, and these are ASCII, so counting characters equals counting bytes.
  return left.length - right.length || a.length - b.length || byText(a, b);
}

// A number with its sign and decimals, or any other character. Of three numbers with points between them, none has decimals.
const PART = /(?<sign>(?<![\p{Alphabetic}\p{N}])-)?(?<digits>\d+)(?:\.(?<decimals>\d+)(?!\d|\.\d))?|./suy;
const BEFORE_TIME = /(?:^|[^.\p{Alphabetic}\p{N}]|(?<![a-z])(?:t|time))$/iu;

function partsOf(text) {
  const parts = [];
  for (let at = 0; at < text.length; at += parts.at(-1).length) {
    PART.lastIndex = at;
    const { 0: run, groups: { sign = '', digits, decimals } } = PART.exec(text);
    const isTime = decimals !== undefined && mayBeTime(text.slice(0, at), digits, decimals);
    parts.push(digits === undefined ? { character: run, length: run.length } : {
      character: sign || '0',
      digits: digits.replace(/^0+/, ''),
      decimals: isTime ? decimals : '',
      length: isTime ? run.length : sign.length + digits.length,
    });
  }
  return parts;
}

function mayBeTime(before, digits, decimals) {
  if (/^0\d/.test(digits) || /\d\.$/.test(before)) return false;
  return digits === '0' && decimals.length < 3 || BEFORE_TIME.test(before);
}

function compare(a, b) {
  const byCharacter = a.character.codePointAt(0) - b.character.codePointAt(0) || isNumber(a) - isNumber(b);
  if (byCharacter !== 0 || !isNumber(a)) return byCharacter;
  const byValue = a.digits.length - b.digits.length || byText(a.digits, b.digits) || byText(a.decimals, b.decimals);
  return a.character === '-' ? -byValue : byValue;
}

const isNumber = part => part.digits !== undefined;
const byText = (a, b) => a < b ? -1 : Number(a > b);

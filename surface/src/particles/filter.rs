//! Chooses particles by a condition on their attributes.
//!
//! ```text
//!   condition  =  term { "or" term }
//!   term       =  factor { "and" factor }
//!   factor     =  "not" factor  |  "(" condition ")"  |  test
//!   test       =  name                                            the value is not 0
//!              |  name ( "==" | "!=" | "<" | "<=" | ">" | ">=" ) value
//!              |  name [ "not" ] "in" value { "," value }         the values may be in parentheses
//!   name       =  word  |  text in quotes
//!   value      =  number  |  word  |  text in quotes
//! ```
//!
//! `velocity.y` and `velocity.1` are a component of the attribute `velocity`, unless an attribute has this
//! whole name. `x`, `y` and `z` are the coordinates, unless an attribute has this name. Not a number (NaN) is unequal to every number, and neither less nor greater.

use std::cmp::Ordering;
use std::fmt;
use std::str::FromStr;

use glam::DVec3;

use super::{Attribute, AttributeValues, OwnedPositions, Positions, Role};

/// A condition on the attributes of particles, such as `phase == 0`: the particles that meet it form the
/// surface.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(into = "String", try_from = "String")]
pub struct ParticleFilter {
    /// The condition as it was given.
    text: String,
    condition: Condition,
}

#[derive(Clone, Debug, PartialEq)]
enum Condition {
    Any(Vec<Condition>),
    All(Vec<Condition>),
    Not(Box<Condition>),
    Test(Test),
}

/// Compares an attribute with one or more values.
#[derive(Clone, Debug, PartialEq)]
struct Test {
    /// The name of the attribute, perhaps with a component.
    name: String,
    /// The results of a comparison that meet the test.
    allowed: &'static [Ordering],
    /// One of these values suffices.
    values: Vec<ConditionOperand>,
}

/// A value in a condition. A number without quotes may also be the text of an attribute with texts.
#[derive(Clone, Debug, PartialEq)]
struct ConditionOperand {
    text: Option<String>,
    number: Option<f64>,
    /// The number, if it is an integer: `f64` cannot represent all of them.
    integer: Option<i64>,
}

impl ParticleFilter {
    /// The indices of the attributes that the condition needs. `attributes` need no values.
    ///
    /// # Errors
    /// A sentence with the attributes that exist, if one is missing, or is compared with the wrong kind of
    /// value.
    pub fn needed(&self, attributes: &[Attribute]) -> Result<Vec<usize>, String> {
        let mut needed = Vec::new();
        self.condition.visit(&mut |test| {
            let (index, _) = found(attributes, &test.name)?;
            test.operands(&attributes[index])?;
            needed.push(index);
            Ok(())
        })?;
        needed.sort_unstable();
        needed.dedup();
        Ok(needed)
    }

    /// Whether each of `count` particles meets the condition. Each attribute has values for all of them;
    /// attributes that the condition does not [need](Self::needed) may be missing.
    ///
    /// # Errors
    /// As for [`needed`](Self::needed).
    pub fn mask(&self, attributes: &[Attribute], count: usize) -> Result<Vec<bool>, String> {
        self.condition.mask(attributes, count)
    }

    /// The particles that meet the condition, with their attributes.
    ///
    /// # Errors
    /// As for [`needed`](Self::needed).
    pub fn chosen(
        &self,
        positions: &Positions<'_>,
        attributes: &[Attribute],
    ) -> Result<(OwnedPositions, Vec<Attribute>), String> {
        // Most conditions need no coordinates.
        if self.needed(attributes).is_ok() {
            let mask = self.mask(attributes, positions.len())?;
            return Ok(rows_of(positions, attributes, &mask));
        }
        let mut all = attributes.to_vec();
        all.extend(coordinates(attributes));
        for index in self.needed(&all)?.into_iter().filter(|index| *index >= attributes.len()) {
            all[index].values =
                coordinate(&all[index].name, positions.len(), |index| positions.position(index));
        }
        let mask = self.mask(&all, positions.len())?;
        Ok(rows_of(positions, attributes, &mask))
    }
}

/// Attributes for the coordinates of particles, without values: those whose names no other attribute has.
pub fn coordinates(attributes: &[Attribute]) -> Vec<Attribute> {
    let is_free = |name: &&str| !attributes.iter().any(|attribute| attribute.name == *name);
    let axes = ["x", "y", "z"].into_iter().filter(is_free);
    let header = |name: &str| Attribute {
        name: name.to_owned(),
        role: Role::Other,
        arity: 1,
        values: AttributeValues::Numbers(Vec::new()),
    };
    axes.map(header).collect()
}

/// The values of one of these [`coordinates`], for `count` particles.
pub fn coordinate(name: &str, count: usize, position: impl Fn(usize) -> DVec3) -> AttributeValues {
    let axis = usize::from(name == "y") + 2 * usize::from(name == "z");
    AttributeValues::Numbers((0..count).map(|index| position(index)[axis] as f32).collect())
}

/// The particles for which `mask` is true, with their attributes.
pub(crate) fn rows_of(
    positions: &Positions<'_>,
    attributes: &[Attribute],
    mask: &[bool],
) -> (OwnedPositions, Vec<Attribute>) {
    let positions = match positions {
        Positions::F32(positions) => OwnedPositions::F32(rows(positions, 1, mask)),
        Positions::F64(positions) => OwnedPositions::F64(rows(positions, 1, mask)),
    };
    let attributes = attributes.iter().map(|attribute| {
        let arity = attribute.arity;
        let values = match &attribute.values {
            AttributeValues::Numbers(values) => AttributeValues::Numbers(rows(values, arity, mask)),
            AttributeValues::Integers(values) => AttributeValues::Integers(rows(values, arity, mask)),
            AttributeValues::Strings { table, indices } => {
                AttributeValues::Strings { table: table.clone(), indices: rows(indices, arity, mask) }
            }
        };
        Attribute { name: attribute.name.clone(), values, ..*attribute }
    });
    (positions, attributes.collect())
}

/// The rows of `arity` values for which `mask` is true.
pub(crate) fn rows<T: Copy>(values: &[T], arity: usize, mask: &[bool]) -> Vec<T> {
    let chosen = values.chunks_exact(arity.max(1)).zip(mask).filter(|(_, is_chosen)| **is_chosen);
    chosen.flat_map(|(row, _)| row).copied().collect()
}

impl Condition {
    fn visit(&self, test: &mut dyn FnMut(&Test) -> Result<(), String>) -> Result<(), String> {
        match self {
            Condition::Any(parts) | Condition::All(parts) => {
                parts.iter().try_for_each(|part| part.visit(test))
            }
            Condition::Not(part) => part.visit(test),
            Condition::Test(own) => test(own),
        }
    }

    fn mask(&self, attributes: &[Attribute], count: usize) -> Result<Vec<bool>, String> {
        let combined = |parts: &[Condition], is_any: bool| {
            let mut mask = vec![!is_any; count];
            for part in parts {
                for (all, one) in mask.iter_mut().zip(part.mask(attributes, count)?) {
                    *all = if is_any { *all | one } else { *all & one };
                }
            }
            Ok(mask)
        };
        match self {
            Condition::Any(parts) => combined(parts, true),
            Condition::All(parts) => combined(parts, false),
            Condition::Not(part) => {
                let mut mask = part.mask(attributes, count)?;
                mask.iter_mut().for_each(|one| *one = !*one);
                Ok(mask)
            }
            Condition::Test(test) => test.mask(attributes),
        }
    }
}

/// The operands of a test, in the type of the attribute.
enum Operands<'a> {
    Numbers(Vec<f32>),
    /// Integers, or else numbers.
    Integers(Vec<Result<i64, f64>>),
    Texts(Vec<&'a str>),
}

impl Test {
    /// Whether the attribute of each particle meets the test.
    fn mask(&self, attributes: &[Attribute]) -> Result<Vec<bool>, String> {
        let (index, component) = found(attributes, &self.name)?;
        let attribute = &attributes[index];
        let arity = attribute.arity;
        Ok(match (&attribute.values, self.operands(attribute)?) {
            (AttributeValues::Numbers(values), Operands::Numbers(operands)) => {
                column(values, component, arity)
                    .map(|value| operands.iter().any(|operand| self.allows(value.partial_cmp(operand))))
                    .collect()
            }
            (AttributeValues::Integers(values), Operands::Integers(operands)) => {
                let compare = |value: i64, operand: &Result<i64, f64>| match operand {
                    Ok(integer) => Some(value.cmp(integer)),
                    Err(number) => (value as f64).partial_cmp(number),
                };
                column(values, component, arity)
                    .map(|&value| operands.iter().any(|operand| self.allows(compare(value, operand))))
                    .collect()
            }
            (AttributeValues::Strings { table, indices }, Operands::Texts(operands)) => {
                let meets = |text: &String| {
                    operands.iter().any(|operand| self.allows(Some(text.as_str().cmp(operand))))
                };
                let meets: Vec<bool> = table.iter().map(meets).collect();
                let of_index = |index: &i32| usize::try_from(*index).ok().and_then(|index| meets.get(index));
                column(indices, component, arity)
                    .map(|index| of_index(index).is_some_and(|meets| *meets))
                    .collect()
            }
            // `operands` returns the type of the attribute.
            _ => Vec::new(),
        })
    }

    fn allows(&self, order: Option<Ordering>) -> bool {
        order.is_some_and(|order| self.allowed.contains(&order))
    }

    /// The values to compare with, in the type of the attribute.
    fn operands<'a>(&'a self, attribute: &Attribute) -> Result<Operands<'a>, String> {
        let name = &attribute.name;
        let number = |operand: &ConditionOperand| {
            operand.number.ok_or_else(|| {
                let text = operand.text.as_deref().unwrap_or_default();
                format!("the attribute `{name}` has numbers, so it cannot be compared with the text `{text}`")
            })
        };
        Ok(match &attribute.values {
            AttributeValues::Numbers(_) => {
                let numbers = self.values.iter().map(|operand| Ok(number(operand)? as f32));
                Operands::Numbers(numbers.collect::<Result<_, String>>()?)
            }
            AttributeValues::Integers(_) => {
                let integer = |operand: &ConditionOperand| match operand.integer {
                    Some(integer) => Ok(Ok(integer)),
                    None => number(operand).map(Err),
                };
                Operands::Integers(self.values.iter().map(integer).collect::<Result<_, String>>()?)
            }
            AttributeValues::Strings { .. } => {
                let text = |operand: &'a ConditionOperand| {
                    operand.text.as_deref().ok_or_else(|| {
                        format!("the attribute `{name}` is text: compare it, as in {name} == fluid")
                    })
                };
                Operands::Texts(self.values.iter().map(text).collect::<Result<_, String>>()?)
            }
        })
    }
}

/// One component of the values of all particles.
fn column<T>(values: &[T], component: usize, arity: usize) -> impl Iterator<Item = &T> {
    values.iter().skip(component).step_by(arity.max(1))
}

/// The attribute that a name in a condition refers to, and the component.
fn found(attributes: &[Attribute], name: &str) -> Result<(usize, usize), String> {
    let named = |name: &str| {
        let position = |is: &dyn Fn(&Attribute) -> bool| attributes.iter().position(is);
        position(&|attribute| attribute.name == name)
            .or_else(|| position(&|attribute| attribute.name.eq_ignore_ascii_case(name)))
            .or_else(|| position(&|attribute| attribute.matches(name)))
    };
    if let Some(index) = named(name) {
        return match attributes[index].arity {
            1 => Ok((index, 0)),
            arity => Err(format!(
                "the attribute `{name}` has {arity} values per particle: name one of them, such as {name}.x"
            )),
        };
    }
    let component = |suffix: &str| match suffix {
        "x" | "y" | "z" | "w" => "xyzw".find(suffix),
        digits => digits.parse().ok(),
    };
    let parts = name.rsplit_once('.').and_then(|(stem, suffix)| Some((named(stem)?, component(suffix)?)));
    if let Some((index, component)) = parts {
        return match attributes[index].arity {
            arity if component < arity => Ok((index, component)),
            arity => Err(format!(
                "`{name}` does not exist, because the attribute `{}` has {arity} values per particle",
                attributes[index].name
            )),
        };
    }
    let names: Vec<&str> = attributes.iter().map(|attribute| &*attribute.name).collect();
    let available = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
    Err(format!("the particles have no attribute `{name}`; available: {available}"))
}

impl fmt::Display for ParticleFilter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

impl FromStr for ParticleFilter {
    type Err = String;

    fn from_str(text: &str) -> Result<ParticleFilter, String> {
        let text = text.trim();
        let parse = || {
            let mut parser = ConditionParser { tokens: tokens(text)?, next: 0, depth: 0 };
            let condition = parser.condition()?;
            if parser.next < parser.tokens.len() {
                return Err(parser.expected("`and`, `or` or the end"));
            }
            Ok(condition)
        };
        match parse() {
            Ok(condition) => Ok(ParticleFilter { text: text.to_owned(), condition }),
            Err(why) => Err(format!("`{text}` is not a condition such as phase == 0: {why}")),
        }
    }
}

/// A part of a condition, and the number of its first character, from 1.
struct Token<'a> {
    kind: TokenKind<'a>,
    character: usize,
}

#[derive(Clone, Copy)]
enum TokenKind<'a> {
    /// A name, a number or a keyword.
    Word(&'a str),
    /// Text in quotes, without them.
    Quoted(&'a str),
    Symbol(&'static str),
}

/// All symbols, the longer ones first. Some have no meaning, and are here to be named in errors.
const SYMBOLS: [&str; 15] = ["==", "!=", "<=", ">=", "<", ">", "(", ")", "[", "]", ",", "=", "!", "&", "|"];

/// Words with a meaning, which must be in quotes if they are names or values.
const KEYWORDS: [&str; 4] = ["and", "or", "not", "in"];

fn tokens(text: &str) -> Result<Vec<Token<'_>>, String> {
    let ends_word = |c: char| c.is_whitespace() || "'\"()[],=<>!&|".contains(c);
    let mut tokens = Vec::new();
    let (mut rest, mut character) = (text, 1);
    loop {
        let spaces = rest.len() - rest.trim_start().len();
        character += rest[..spaces].chars().count();
        rest = &rest[spaces..];
        let Some(first) = rest.chars().next() else { return Ok(tokens) };
        let (kind, length) = if matches!(first, '\'' | '"') {
            let length = rest[1..].find(first);
            let length = length.ok_or_else(|| format!("the quote at character {character} is not closed"))?;
            (TokenKind::Quoted(&rest[1..=length]), length + 2)
        } else if let Some(symbol) = SYMBOLS.iter().find(|symbol| rest.starts_with(**symbol)) {
            (TokenKind::Symbol(symbol), symbol.len())
        } else {
            let length = rest.find(ends_word).unwrap_or(rest.len());
            (TokenKind::Word(&rest[..length]), length)
        };
        tokens.push(Token { kind, character });
        character += rest[..length].chars().count();
        rest = &rest[length..];
    }
}

struct ConditionParser<'a> {
    tokens: Vec<Token<'a>>,
    /// The index of the next token.
    next: usize,
    /// The number of surrounding parentheses and negations.
    depth: usize,
}

/// Deeper conditions are refused, because each level takes memory of the stack.
const DEPTH_MAX: usize = 100;

impl<'a> ConditionParser<'a> {
    fn condition(&mut self) -> Result<Condition, String> {
        let mut parts = vec![self.term()?];
        while self.take_word("or") {
            parts.push(self.term()?);
        }
        Ok(if parts.len() == 1 { parts.remove(0) } else { Condition::Any(parts) })
    }

    fn term(&mut self) -> Result<Condition, String> {
        let mut parts = vec![self.factor()?];
        while self.take_word("and") {
            parts.push(self.factor()?);
        }
        Ok(if parts.len() == 1 { parts.remove(0) } else { Condition::All(parts) })
    }

    fn factor(&mut self) -> Result<Condition, String> {
        if self.depth == DEPTH_MAX {
            return Err(format!("it is nested more than {DEPTH_MAX} times"));
        }
        self.depth += 1;
        let factor = if self.take_word("not") {
            Condition::Not(self.factor()?.into())
        } else if self.take_symbol("(") {
            let condition = self.condition()?;
            if !self.take_symbol(")") {
                return Err(self.expected("`and`, `or` or )"));
            }
            condition
        } else {
            self.test()?
        };
        self.depth -= 1;
        Ok(factor)
    }

    fn test(&mut self) -> Result<Condition, String> {
        const OPERATORS: [(&str, &[Ordering], bool); 6] = [
            ("==", &[Ordering::Equal], false),
            ("!=", &[Ordering::Equal], true),
            ("<", &[Ordering::Less], false),
            ("<=", &[Ordering::Less, Ordering::Equal], false),
            (">", &[Ordering::Greater], false),
            (">=", &[Ordering::Greater, Ordering::Equal], false),
        ];
        let name = match self.peek() {
            Some(TokenKind::Quoted(name)) => name,
            Some(TokenKind::Word(name)) if !is_keyword(name) && !is_numeric(name) => name,
            _ => return Err(self.expected("the name of an attribute")),
        };
        let name = name.to_owned();
        self.next += 1;
        let is_negated = self.take_word("not");
        let (allowed, is_negated, values) = if self.take_word("in") {
            (OPERATORS[0].1, is_negated, self.values()?)
        } else if is_negated {
            return Err(self.expected("in"));
        } else if let Some((_, allowed, is_negated)) =
            OPERATORS.iter().find(|(symbol, ..)| self.take_symbol(symbol))
        {
            (*allowed, *is_negated, vec![self.value()?])
        } else if self.ends_test() {
            let zero = ConditionOperand { text: None, number: Some(0.0), integer: Some(0) };
            (OPERATORS[0].1, true, vec![zero])
        } else {
            return Err(self.expected("==, !=, <, <=, >, >= or in"));
        };
        let test = Condition::Test(Test { name, allowed, values });
        Ok(if is_negated { Condition::Not(test.into()) } else { test })
    }

    /// Whether the next token cannot continue a test.
    fn ends_test(&self) -> bool {
        match self.peek() {
            None | Some(TokenKind::Symbol(")")) => true,
            Some(TokenKind::Word(word)) => is_keyword(word),
            _ => false,
        }
    }

    fn values(&mut self) -> Result<Vec<ConditionOperand>, String> {
        let closing = [("(", ")"), ("[", "]")].into_iter().find(|(opening, _)| self.take_symbol(opening));
        let mut values = vec![self.value()?];
        while self.take_symbol(",") {
            values.push(self.value()?);
        }
        match closing {
            Some((_, closing)) if !self.take_symbol(closing) => {
                Err(self.expected(&format!("a comma or {closing}")))
            }
            _ => Ok(values),
        }
    }

    fn value(&mut self) -> Result<ConditionOperand, String> {
        let operand = match self.peek() {
            Some(TokenKind::Quoted(text)) => {
                ConditionOperand { text: Some(text.to_owned()), number: None, integer: None }
            }
            Some(TokenKind::Word(word)) if is_numeric(word) => {
                let number = word.parse().ok().filter(|number: &f64| number.is_finite());
                if number.is_none() {
                    return Err(self.expected("a number, or a text in quotes"));
                }
                ConditionOperand { text: Some(word.to_owned()), number, integer: word.parse().ok() }
            }
            Some(TokenKind::Word(word)) if !is_keyword(word) => {
                ConditionOperand { text: Some(word.to_owned()), number: None, integer: None }
            }
            _ => return Err(self.expected("a number or a text")),
        };
        self.next += 1;
        Ok(operand)
    }

    fn peek(&self) -> Option<TokenKind<'a>> {
        self.tokens.get(self.next).map(|token| token.kind)
    }

    fn take_word(&mut self, wanted: &str) -> bool {
        let is_next = matches!(self.peek(), Some(TokenKind::Word(word)) if word.eq_ignore_ascii_case(wanted));
        self.next += usize::from(is_next);
        is_next
    }

    fn take_symbol(&mut self, wanted: &str) -> bool {
        let is_next = matches!(self.peek(), Some(TokenKind::Symbol(symbol)) if symbol == wanted);
        self.next += usize::from(is_next);
        is_next
    }

    /// The error if the next token is not what is expected.
    fn expected(&self, what: &str) -> String {
        match self.tokens.get(self.next) {
            None => format!("expected {what} at its end"),
            Some(Token { kind, character }) => {
                let (TokenKind::Word(found) | TokenKind::Quoted(found) | TokenKind::Symbol(found)) = kind;
                format!("expected {what} at character {character}, found `{found}`")
            }
        }
    }
}

fn is_keyword(word: &str) -> bool {
    KEYWORDS.iter().any(|keyword| word.eq_ignore_ascii_case(keyword))
}

/// Whether a word has to be a number.
fn is_numeric(word: &str) -> bool {
    word.starts_with(|c: char| c.is_ascii_digit() || "+-.".contains(c))
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::particles::Role;

    /// Five particles: `phase` 0 1 2 3 2^53 + 1, `density` 0.1 to 0.5, `kind` fluid or wall or none,
    /// `velocity` (i, -i, 0).
    fn particles() -> Vec<Attribute> {
        let attribute =
            |name: &str, role, arity, values| Attribute { name: name.into(), role, arity, values };
        let table: Arc<[String]> = ["fluid".to_owned(), "side wall".to_owned(), "7".to_owned()].into();
        let velocities = (0..5).flat_map(|i| [i as f32, -i as f32, 0.0]).collect();
        vec![
            attribute("Phase", Role::Other, 1, AttributeValues::Integers(vec![0, 1, 2, 3, (1 << 53) + 1])),
            attribute(
                "density [kg/m^3]",
                Role::Other,
                1,
                AttributeValues::Numbers(vec![0.1, 0.2, 0.3, 0.4, f32::NAN]),
            ),
            attribute(
                "kind",
                Role::Other,
                1,
                AttributeValues::Strings { table, indices: vec![0, 1, 2, -1, 0] },
            ),
            attribute("vel", Role::Velocity, 3, AttributeValues::Numbers(velocities)),
        ]
    }

    fn chosen(text: &str) -> Result<Vec<usize>, String> {
        let filter: ParticleFilter = text.parse()?;
        assert_eq!(filter.to_string().parse(), Ok(filter.clone()));
        filter.needed(&particles())?;
        let mask = filter.mask(&particles(), 5)?;
        assert_eq!(mask.len(), 5, "{text}");
        Ok((0..5).filter(|&index| mask[index]).collect())
    }

    #[test]
    fn conditions_choose_particles() {
        let table: &[(&str, &[usize])] = &[
            ("phase == 0", &[0]),
            ("PHASE!=0", &[1, 2, 3, 4]),
            ("phase in 1,2", &[1, 2]),
            ("phase in (0, 3)", &[0, 3]),
            ("phase in [0]", &[0]),
            ("phase not in 0, 1, 2", &[3, 4]),
            ("not phase in 0,1", &[2, 3, 4]),
            ("phase == 9007199254740993", &[4]),
            ("phase == 9007199254740992", &[]),
            ("phase == 1.0", &[1]),
            ("phase < 1.5", &[0, 1]),
            ("phase > -1 and phase <= 2", &[0, 1, 2]),
            ("phase", &[1, 2, 3, 4]),
            ("not phase", &[0]),
            // The decimal number is rounded like the 32-bit values.
            ("'density [kg/m^3]' == 0.1", &[0]),
            ("\"density [kg/m^3]\" >= 3e-1", &[2, 3]),
            ("'density [kg/m^3]' < 1", &[0, 1, 2, 3]),
            ("'density [kg/m^3]' != 0.1", &[1, 2, 3, 4]),
            ("kind == fluid", &[0, 4]),
            ("kind == 'side wall'", &[1]),
            ("kind in fluid, \"side wall\"", &[0, 1, 4]),
            ("kind == 7", &[2]),
            ("kind != fluid", &[1, 2, 3]),
            ("velocity.x >= 3", &[3, 4]),
            ("vel.y < -3", &[4]),
            ("v.1 < -3", &[4]),
            ("phase == 0 or phase == 1 and kind == fluid", &[0]),
            ("(phase == 0 or phase == 1) and not (kind == fluid)", &[1]),
            ("phase == 0 OR phase == 3", &[0, 3]),
            ("not not phase == 0", &[0]),
        ];
        for (text, expected) in table {
            assert_eq!(chosen(text).as_deref(), Ok(*expected), "{text}");
        }
    }

    #[test]
    fn errors_state_the_position_or_the_attributes() {
        let deep = format!("{}phase", "(".repeat(100_000));
        for (text, expected) in [
            ("", "expected the name of an attribute at its end"),
            ("phase = 0", "expected ==, !=, <, <=, >, >= or in at character 7, found `=`"),
            ("phase ==", "expected a number or a text at its end"),
            ("phase == 0 phase", "expected `and`, `or` or the end at character 12, found `phase`"),
            ("phase == 0 && phase", "at character 12, found `&`"),
            ("0 == phase", "expected the name of an attribute at character 1, found `0`"),
            ("phase == 1x", "expected a number, or a text in quotes at character 10, found `1x`"),
            ("phase == 1e999", "found `1e999`"),
            ("phase in (1, 2", "expected a comma or ) at its end"),
            ("(phase == 1", "expected `and`, `or` or ) at its end"),
            ("phase not 1", "expected in at character 11, found `1`"),
            ("kind == 'é", "the quote at character 9 is not closed"),
            ("kind == é\u{a0}or or", "expected the name of an attribute at character 14, found `or`"),
            (&deep, "nested more than 100 times"),
            ("mk == 1", "no attribute `mk`; available: Phase, density [kg/m^3], kind, vel"),
            ("phase == 0 or mk", "no attribute `mk`"),
            ("velocity == 1", "`velocity` has 3 values per particle: name one of them, such as velocity.x"),
            ("vel.w > 0", "`vel.w` does not exist, because the attribute `vel` has 3 values"),
            ("vel.99999999999999999999 > 0", "no attribute `vel.99999999999999999999`"),
            ("phase == fluid", "`Phase` has numbers, so it cannot be compared with the text `fluid`"),
            ("phase == '0'", "cannot be compared with the text `0`"),
            ("kind", "`kind` is text: compare it, as in kind == fluid"),
        ] {
            let why = chosen(text).expect_err(text);
            assert!(why.contains(expected), "{text}: {why}");
        }
        // The attributes are missing together with their values.
        let missing = "phase == 0".parse::<ParticleFilter>().expect("a condition").mask(&[], 0);
        assert!(missing.is_err_and(|why| why.ends_with("available: none")));
    }

    #[test]
    fn chosen_particles_keep_their_attributes() {
        let positions = [0, 1, 2, 3, 4].map(|i| [i as f32; 3]);
        let filter: ParticleFilter = "phase in 1,3".parse().expect("a condition");
        let (positions, attributes) =
            filter.chosen(&Positions::from(&positions), &particles()).expect("attributes");
        assert_eq!(positions, OwnedPositions::F32(vec![[1.0; 3], [3.0; 3]]));
        assert_eq!(attributes[0].values, AttributeValues::Integers(vec![1, 3]));
        assert_eq!(attributes[3].values, AttributeValues::Numbers(vec![1.0, -1.0, 0.0, 3.0, -3.0, 0.0]));
        let AttributeValues::Strings { indices, .. } = &attributes[2].values else { panic!("text") };
        assert_eq!(indices, &[1, -1]);
        assert_eq!(filter.needed(&attributes), Ok(vec![0]));
    }
}
